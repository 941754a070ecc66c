# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Compiled loops that two or more parts share; those of one part are in ``<part>/kernels/``.

Only folders of this name import numba. Ubuntu 24.04, the system of ROS 2 Jazzy, has no package of
numba, so rosdep cannot install it there and it is missing on many robots at first. Importing a
kernel then raises an error that says how to install it.

If numba finds no writable directory for its cache, it refuses to load any kernel; the kernels are
then cached in a temporary directory and compiled at every start.

numba compiles a kernel anew if its own file changed, but not if a kernel that it calls did: after
an update, cached kernels would disagree on the layout of a table. So any change in any folder of
kernels discards the whole cache.
"""

import atexit
import hashlib
import logging
from pathlib import Path
import shutil
import tempfile
from types import FunctionType

from surfel_mapper.errors import DependencyError

HOW_TO_INSTALL = (
    'It compiles the kernels of surfel_mapper. Install it with\n'
    '    pip install numba\n'
    'Ubuntu 24.04 has no apt package of it and guards the system against pip; there, either\n'
    '    python3 -m venv --system-site-packages ~/surfel_mapper_venv\n'
    '    . ~/surfel_mapper_venv/bin/activate && pip install numba\n'
    'and start ROS nodes from the shell with that venv active, or, for all users of the machine,\n'
    '    sudo pip install --break-system-packages numba'
)

try:
    import numba as _numba
except ImportError as error:
    raise DependencyError(f'numba cannot be loaded ({error}). {HOW_TO_INSTALL}') from error


_log = logging.getLogger(__name__)

STAMP = 'kernels.sha256'
"""File beside the cached kernels: the hash of all sources that they were compiled from."""

_PACKAGE = Path(__file__).parents[1]


def _probe() -> None:
    """Take the place of a kernel, to find the cache of its folder; never compiled."""


def _cache_of(folder: Path) -> Path:
    """Return numba's cache directory of a folder; RuntimeError if it can write none."""
    code = _probe.__code__.replace(co_filename=str(folder / '__init__.py'))
    path = _numba.njit(cache=True)(FunctionType(code, {})).stats.cache_path
    assert path is not None, 'cache=True was given'
    return Path(path)


def _discard_stale(directory: Path, digest: bytes) -> None:
    """Remove the cached kernels of a directory unless they were compiled from these sources."""
    stamp = directory / STAMP
    try:
        if stamp.exists() and stamp.read_bytes() == digest:
            return
        for kept in directory.glob('*.nb[ci]'):
            kept.unlink(missing_ok=True)  # another process may do the same
        stamp.write_bytes(digest)
    except OSError as error:
        _log.warning('%s: kernels may be compiled at every start: %s', stamp, error)


try:
    _caches = [_cache_of(each.parent) for each in _PACKAGE.glob('**/kernels/__init__.py')]
except RuntimeError:
    _directory = tempfile.mkdtemp(prefix='surfel_mapper-kernels-')
    atexit.register(shutil.rmtree, _directory, ignore_errors=True)
    _numba.config.CACHE_DIR = _directory  # type: ignore[attr-defined]
    _log.warning(
        'compiled kernels cannot be kept, so every start takes half a minute: set NUMBA_CACHE_DIR '
        'to a directory that can be written'
    )
else:
    if not _numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        _sources = sorted(_PACKAGE.glob('**/kernels/*.py'))
        _digest = hashlib.sha256(b''.join(each.read_bytes() for each in _sources)).digest()
        for _cache in _caches:
            _discard_stale(_cache, _digest)
