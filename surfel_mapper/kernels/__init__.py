# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Compiled loops that two or more parts share; kernels of a single part are in ``<part>/kernels/``.

Only folders of this name import numba. Ubuntu 24.04, the system of ROS 2 Jazzy, does not package
numba, so rosdep cannot install it. If it is missing, importing a kernel raises DependencyError
with the commands that install it.

If numba finds no writable cache directory, it refuses to load any kernel; the kernels are then
cached in a temporary directory and compiled at every start.

numba recompiles a kernel if its own file changed, but not if a kernel that it calls did. After an
update, cached kernels could disagree on the layout of a table. So a change in a module of kernels
discards the cached kernels of that module and of all that import it, directly or not.
"""

import atexit
from collections.abc import Iterable
import hashlib
import logging
import os
from pathlib import Path
import re
import shutil
import tempfile
from types import FunctionType

from surfel_mapper.compilation import PROGRESS
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
    from numba.core import event as _event
except ImportError as error:
    raise DependencyError(f'numba cannot be loaded ({error}). {HOW_TO_INSTALL}') from error


_log = logging.getLogger(__name__)

STAMPS = 'sources.sha256'
"""File beside the cached kernels: by module, the hash of the sources that they come from."""

_PACKAGE = Path(__file__).parents[1]


def _source_digests() -> dict[str, str]:
    """Return by module of kernels the hash of its source and of all kernels that it imports."""
    sources = {
        '.'.join(path.relative_to(_PACKAGE.parent).with_suffix('').parts): path.read_bytes()
        for path in sorted(_PACKAGE.glob('**/kernels/*.py'))
        if path.name != '__init__.py'
    }
    imports = {module: _imported(source, sources) for module, source in sources.items()}
    digests = {}
    for module in sources:
        needed, new = {module}, {module}
        while new:
            new = {name for importer in new for name in imports[importer]} - needed
            needed |= new
        joined = b''.join(sources[name] for name in sorted(needed))
        digests[module] = hashlib.sha256(joined).hexdigest()
    return digests


def _imported(source: bytes, modules: Iterable[str]) -> set[str]:
    """Return the modules that a source imports; importing a folder may mean any module in it."""
    lines = re.findall(rb'^\s*(?:from|import) (surfel_mapper[.\w]*)', source, re.MULTILINE)
    names = {line.decode() for line in lines}
    folders = {name for name in names if name.endswith('.kernels')}
    return {name for name in modules if name in names or name.rpartition('.')[0] in folders}


def _probe() -> None:
    """Stand in for a kernel to locate the cache directory of a folder; never compiled."""


def _cache_of(folder: Path) -> Path:
    """Return numba's cache directory of a folder; RuntimeError if none is writable."""
    code = _probe.__code__.replace(co_filename=str(folder / '__init__.py'))
    path = _numba.njit(cache=True)(FunctionType(code, {})).stats.cache_path
    assert path is not None, 'cache=True was given'
    return Path(path)


def _discard_stale(directory: Path, digests: dict[str, str]) -> None:
    """Remove the cached kernels of a directory that were compiled from other sources."""
    stamps = directory / STAMPS
    try:
        lines = stamps.read_text().splitlines() if stamps.exists() else []
        kept = dict(line.split()[::-1] for line in lines if len(line.split()) == 2)
        if kept == digests:
            return
        unchanged = {name for name, digest in digests.items() if kept.get(name) == digest}
        for file in directory.glob('*.nb[ci]'):  # hashing.find_row-100.py311.nbi
            if file.name.partition('.')[0] not in unchanged:
                file.unlink(missing_ok=True)  # another process may do the same
        text = ''.join(f'{digest}  {name}\n' for name, digest in digests.items())
        written = stamps.with_suffix(f'.{os.getpid()}')  # several processes may start at once
        written.write_text(text)
        written.replace(stamps)
    except OSError as error:
        _log.warning('%s: kernels may be compiled at every start: %s', stamps, error)


def _prepare_cache() -> None:
    """Discard stale kernels; if there is no writable cache, use a temporary directory."""
    try:
        caches = {
            '.'.join(folder.relative_to(_PACKAGE.parent).parts): _cache_of(folder)
            for folder in (init.parent for init in _PACKAGE.glob('**/kernels/__init__.py'))
        }
    except RuntimeError:
        directory = tempfile.mkdtemp(prefix='surfel_mapper-kernels-')
        atexit.register(shutil.rmtree, directory, ignore_errors=True)
        _numba.config.CACHE_DIR = directory  # type: ignore[attr-defined]
        _log.warning(
            'no writable cache directory for compiled kernels, so every start compiles them: set '
            'NUMBA_CACHE_DIR to a writable directory'
        )
        return
    digests = _source_digests()
    for folder, cache in caches.items():
        own = {
            name.rpartition('.')[2]: digest
            for name, digest in digests.items()
            if name.rpartition('.')[0] == folder
        }
        _discard_stale(cache, own)


class _Reporter(_event.Listener):
    """Reports compilations, not loads from the cache; see compilation.py."""

    def on_start(self, event: _event.Event) -> None:
        """Report the begin of one."""
        PROGRESS.begin()

    def on_end(self, event: _event.Event) -> None:
        """Report its end."""
        PROGRESS.end()


if not _numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
    _prepare_cache()
    _event.register('numba:compile', _Reporter())
