# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Compiled loops over arrays; the only place that imports numba.

Ubuntu 24.04, the system of ROS 2 Jazzy, has no package of numba, so rosdep cannot install it there
and it is missing on many a robot at first. Whoever imports a kernel then learns here what to do.

Where numba can write no directory to keep compiled kernels in, it refuses to load any; then they
are kept in a temporary one and compiled at every start.

numba compiles a kernel anew when its own file has changed, not when one has that it calls, whose
old code it may hold: after an update kernels would disagree on how a table is laid out. So all
that is kept goes with any change in this folder.
"""

import atexit
import hashlib
import logging
from pathlib import Path
import shutil
import tempfile

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
"""Beside the compiled kernels, the hash of all sources that they were compiled from."""


def _probe() -> None:
    """Stand for a kernel of this folder; it is never compiled."""


def _forget_unless_of(sources: list[Path], directory: Path) -> None:
    """Remove the compiled kernels of a directory that are not of these sources."""
    found = hashlib.sha256(b''.join(source.read_bytes() for source in sources)).digest()
    stamp = directory / STAMP
    try:
        if stamp.exists() and stamp.read_bytes() == found:
            return
        for kept in directory.glob('*.nb[ci]'):
            kept.unlink(missing_ok=True)  # another process may do the same
        stamp.write_bytes(found)
    except OSError as error:
        _log.warning('%s: kernels may be compiled at every start: %s', stamp, error)


try:
    _compiled = _numba.njit(cache=True)(_probe)
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
        _kept_in = _compiled.stats.cache_path
        assert _kept_in is not None, 'it was told to keep it'
        _forget_unless_of(sorted(Path(__file__).parent.glob('*.py')), Path(_kept_in))
