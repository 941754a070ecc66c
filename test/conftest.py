# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures and settings of all tests: real data, hypothesis without randomness or deadlines."""

from __future__ import annotations

from collections import Counter
import gc
from itertools import zip_longest
import os
from pathlib import Path
import tempfile
import zlib

from hypothesis import HealthCheck, settings
import pytest

# The same examples in every run; the first call of a kernel compiles it, which no deadline allows,
# and a machine that is busy with other things is no fault of a test.
settings.register_profile(
    'repeatable',
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile('repeatable')


DATA_PARTS = ('data', 'golden')


def pytest_configure(config: pytest.Config) -> None:
    """End the run with one message if the folder of real data is not as CONTRIBUTING.md says."""
    gc.disable()  # collecting tests makes a million objects and no garbage; a quarter of its time
    if hasattr(config, 'workerinput'):  # of pytest-xdist
        compile_in_turn(Path(tempfile.gettempdir()))
    folder = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    missing = [part for part in DATA_PARTS if folder and not (Path(folder) / part).is_dir()]
    if missing:
        pytest.exit(
            f'SURFEL_MAPPER_TEST_DATA={folder}: no folder {" and no ".join(missing)}, expected '
            'data/ and golden/ as CONTRIBUTING.md describes; unset it to skip tests of real data',
            returncode=pytest.ExitCode.USAGE_ERROR,
        )


def compile_in_turn(folder: Path) -> None:
    """
    Let one process at a time compile a kernel; the others wait, and find it in numba's cache.

    Without, three processes spend a quarter of the time of compiling on kernels that another one
    compiles too. Kernels are parts of one file in a folder, by their names: calls between
    kernels have no cycle, so the locks have none.
    """
    import fcntl

    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    lock = os.open(folder / f'surfel_mapper-compiling-{os.getuid()}', os.O_RDWR | os.O_CREAT)
    compile_now, depths = Dispatcher.compile, Counter[int]()

    def compile_alone(self: Dispatcher, signature: object) -> object:
        if self.stats.cache_path is None:
            return compile_now(self, signature)
        place = zlib.crc32(f'{self.stats.cache_path} {self.py_func.__qualname__}'.encode())
        with global_compiler_lock:
            if not depths[place]:
                fcntl.lockf(lock, fcntl.LOCK_EX, 1, place)
            depths[place] += 1
            try:
                return compile_now(self, signature)
            finally:
                depths[place] -= 1
                if not depths[place]:
                    fcntl.lockf(lock, fcntl.LOCK_UN, 1, place)

    Dispatcher.compile = compile_alone


WAITING = ('test/ros/', 'test/cluster/', 'test/viz/test_view_browser', 'test/viz/test_report_b')
"""Tests of processes, which wait for each other half of their time."""

LONGEST = (
    'test/fuzz/test_fuzz.py',
    'test/docs/test_tutorials.py',
    'test/cli/test_replay_registration.py',
    'test/examples/test_examples.py',
)
"""Files of few tests with 7 to 15 s of processor time each."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """
    Order the files so that one process computes while the other waits, and both end together.

    Files that wait alternate with others from the beginning; the remaining ones are short.
    """
    files: dict[str, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.nodeid.partition('::')[0], []).append(item)
    waiting = [name for name in files if name.startswith(WAITING)]
    others = [name for name in files if not name.startswith(WAITING)]
    others.sort(key=lambda name: (name not in LONGEST, -len(files[name])))
    pairs = zip_longest(waiting, others)
    items[:] = [item for pair in pairs for name in pair if name for item in files[name]]


def pytest_collection_finish() -> None:
    """Exclude modules and tests, which are kept to the end, from further garbage collections."""
    gc.enable()
    gc.freeze()


@pytest.fixture(scope='session')
def data_folder() -> Path:
    """Return the folder with data/ (real scans and bags) and golden/ (reference values)."""
    folder = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    if not folder:
        pytest.skip('SURFEL_MAPPER_TEST_DATA is not set: no real data')
    return Path(folder)


@pytest.fixture
def undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """
    Let replays leave out map.png and report.html, except in tests with the mark ``drawn``.

    They are nine tenths of the time of a replay of a few scans, .5 s.
    """
    if request.node.get_closest_marker('drawn') is None:
        from surfel_mapper.offline import outputs

        for name in ('draw_map', 'write_report'):
            monkeypatch.setattr(outputs, name, lambda *_, **__: None)
