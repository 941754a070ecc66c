# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Compiled loops over arrays; the only place that imports numba.

Ubuntu 24.04, the system of ROS 2 Jazzy, has no package of numba, so rosdep cannot install it there
and it is missing on many a robot at first. Whoever imports a kernel then learns here what to do.

Where numba can write no directory to keep compiled kernels in, it refuses to load any; then they
are kept in a temporary one and compiled at every start.
"""

import atexit
import logging
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


def _probe() -> None:
    """Stand for a kernel of this folder; it is never compiled."""


try:
    _numba.njit(cache=True)(_probe)
except RuntimeError:
    _directory = tempfile.mkdtemp(prefix='surfel_mapper-kernels-')
    atexit.register(shutil.rmtree, _directory, ignore_errors=True)
    _numba.config.CACHE_DIR = _directory  # type: ignore[attr-defined]
    logging.getLogger(__name__).warning(
        'compiled kernels cannot be kept, so every start takes half a minute: set NUMBA_CACHE_DIR '
        'to a directory that can be written'
    )
