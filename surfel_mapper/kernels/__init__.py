# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Compiled loops that two or more parts share; kernels of a single part are in ``<part>/kernels/``.

Only folders of this name import numba. Ubuntu 24.04, the system of ROS 2 Jazzy, does not package
numba, so rosdep cannot install it. If it is missing, importing a kernel raises DependencyError
with the commands that install it.

If numba finds no writable cache directory, it refuses to load any kernel; the kernels are then
cached in a temporary directory and compiled at every start.

numba recompiles a kernel if its own file changed, but not if a kernel that it calls did: after an
update, cached kernels could disagree on the layout of a table. So any change in any folder of
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
    'surfel_mapper needs it to compile its kernels. Install it with\n'
    '    pip install numba\n'
    'On Ubuntu 24.04, which has no apt package of numba, use a virtual environment:\n'
    '    python3 -m venv --system-site-packages ~/surfel_mapper_venv\n'
    '    . ~/surfel_mapper_venv/bin/activate && pip install numba\n'
    'and start ROS nodes from the shell with that venv active; or install it for all users:\n'
    '    sudo pip install --break-system-packages numba'
)

try:
    import numba as _numba
except ImportError as error:
    raise DependencyError(f'numba cannot be loaded ({error}). {HOW_TO_INSTALL}') from error


_log = logging.getLogger(__name__)

STAMP = 'kernels.sha256'
"""File beside the cached kernels: hash of the sources that they were compiled from."""

_PACKAGE = Path(__file__).parents[1]


def _probe() -> None:
    """Stand in for a kernel to locate the cache directory of a folder; never compiled."""


def _cache_of(folder: Path) -> Path:
    """Return numba's cache directory of a folder; RuntimeError if none is writable."""
    code = _probe.__code__.replace(co_filename=str(folder / '__init__.py'))
    path = _numba.njit(cache=True)(FunctionType(code, {})).stats.cache_path
    assert path is not None, 'cache=True was given'
    return Path(path)


def _discard_stale(directory: Path, digest: bytes) -> None:
    """Remove the cached kernels of a directory if they were compiled from other sources."""
    stamp = directory / STAMP
    try:
        if stamp.exists() and stamp.read_bytes() == digest:
            return
        for kept in directory.glob('*.nb[ci]'):
            kept.unlink(missing_ok=True)  # another process may do the same
        stamp.write_bytes(digest)
    except OSError as error:
        _log.warning('%s: kernels may be compiled at every start: %s', stamp, error)


def _prepare_cache() -> None:
    """Discard stale kernels; if there is no writable cache, use a temporary directory."""
    try:
        caches = [_cache_of(each.parent) for each in _PACKAGE.glob('**/kernels/__init__.py')]
    except RuntimeError:
        directory = tempfile.mkdtemp(prefix='surfel_mapper-kernels-')
        atexit.register(shutil.rmtree, directory, ignore_errors=True)
        _numba.config.CACHE_DIR = directory  # type: ignore[attr-defined]
        _log.warning(
            'no writable cache directory for compiled kernels, so every start takes half a '
            'minute: set NUMBA_CACHE_DIR to a writable directory'
        )
        return
    sources = sorted(_PACKAGE.glob('**/kernels/*.py'))
    digest = hashlib.sha256(b''.join(each.read_bytes() for each in sources)).digest()
    for cache in caches:
        _discard_stale(cache, digest)


if not _numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
    _prepare_cache()
