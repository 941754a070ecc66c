# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Every step of saving, and allocations of insert, remove and load, fail once in turn.

Afterwards a file has the digest of the old map or of the new one, and a map in memory that of
before or after. A step is an open, write, flush, fsync or rename; it fails with a full disk, or
the process is killed there (SIGKILL). Allocations are those of Python (_testcapi.set_nomemory);
memory that NumPy and kernels get from the system is not among them.

Allocations, steps of a replay, and kills in a writer of many steps are sampled. With
SURFEL_MAPPER_EVERY_FAILURE each is tried, but of a replay only allocations whose number is a power
of 1.2, and of those up to its map one share of 32: ``make fuzz`` sets the variable to that of
a share, the next one at each call. With ``all`` it tries all shares, which takes an hour.
"""

from __future__ import annotations

import contextlib
import errno
from itertools import count
import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError, SurfelMapperError
from surfel_mapper.files import atomic, pcd, ply
from surfel_mapper.files.map_state import load_map, save_map
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.offline.replay import replay
from test.bags import recorded

pytestmark = pytest.mark.skipif(not hasattr(os, 'fork'), reason='needs fork')

SHARE = os.environ.get('SURFEL_MAPPER_EVERY_FAILURE')
EVERY = SHARE is not None

SHARES = 32
"""Runs of ``make fuzz`` in a row, together, let each allocation of a replay up to its map fail."""

MOST_CRASHES = 0.01
"""Share of allocations that may end the process: numba does not check those of its dispatcher."""

MOST_KILLS = 20
"""Steps of a writer at which the process is killed; each takes a fork, of 50 ms."""

AFTER_LAST = 50
"""Successes in a row after which an operation is taken to make no more allocations."""


class Steps:
    """Counts the steps of writing a file, and fails at one of them."""

    def __init__(self, monkeypatch, fail_at=None, kill=False):
        self.done = 0
        self._fail_at, self._kill = fail_at, kill
        self._open, self._fsync, self._replace = open, os.fsync, os.replace
        monkeypatch.setattr(atomic, 'open', self.open, raising=False)
        monkeypatch.setattr(atomic.os, 'fsync', self.wrapped(os.fsync))
        monkeypatch.setattr(atomic.os, 'replace', self.wrapped(os.replace))

    def step(self):
        self.done += 1
        if self.done - 1 == self._fail_at:
            if self._kill:
                os.kill(os.getpid(), signal.SIGKILL)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def wrapped(self, function):
        def call(*args, **kwargs):
            self.step()
            return function(*args, **kwargs)

        return call

    def open(self, *args, **kwargs):
        self.step()
        return StepFile(self._open(*args, **kwargs), self)


class StepFile:
    """A file whose writes and flushes are steps."""

    def __init__(self, file, steps):
        self._file = file
        self._steps = steps

    def write(self, content):
        self._steps.step()
        return self._file.write(content)

    def flush(self):
        self._steps.step()
        self._file.flush()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._file.close()

    def __getattr__(self, name):
        return getattr(self._file, name)


def map_of(seed):
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.random.default_rng(seed).uniform(-2.0, 2.0, (50, 3)))
    return surfel_map


def write_parquet(path, surfel_map):
    from surfel_mapper.files.parquet import write_map

    write_map(path, surfel_map)


WRITERS = {
    'npz': save_map,
    'npz packed': lambda path, surfel_map: save_map(path, surfel_map, compress=True),
    'parquet': write_parquet,
    'ply': lambda path, surfel_map: ply.write_surfels(path, surfel_map.surfels()),
    'pcd': lambda path, surfel_map: pcd.write_surfels(path, surfel_map.surfels()),
    'json': lambda path, surfel_map: atomic.write_json(path, {'digest': surfel_map.digest()}),
}


@pytest.mark.parametrize('kill', [False, True], ids=['full disk', 'killed'])
@pytest.mark.parametrize('name', WRITERS)
def test_a_save_that_fails_at_any_step_leaves_the_old_file_or_the_new(tmp_path, name, kill):
    if name == 'parquet':
        pytest.importorskip('pyarrow')
    write, path = WRITERS[name], tmp_path / 'a'
    old, new = map_of(1), map_of(2)
    write(path, new)
    new_bytes = path.read_bytes()
    write(path, old)
    old_bytes = path.read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        steps = Steps(patch)
        write(path, old)
    assert steps.done >= 5
    stride = 1 if EVERY or not kill else -(-steps.done // MOST_KILLS)
    for number in range(0, steps.done, stride):
        failed = attempt(lambda number=number: write(path, new), number, kill)
        found = path.read_bytes()
        assert found in (old_bytes, new_bytes), (name, number)
        assert failed or found == new_bytes, (name, number)  # the sync of the directory may fail
        write(path, old)
        left = [file for file in tmp_path.iterdir() if file != path]
        assert kill or not left, (name, number, left)
        for file in left:
            file.unlink()


def attempt(write, number, kill):
    """Write, failing at a step; return whether that raised our error, or killed the process."""
    if not kill:
        with pytest.MonkeyPatch.context() as patch:
            Steps(patch, number)
            try:
                write()
            except FileFormatError:
                return True
        return False
    child = os.fork()
    if not child:
        Steps(pytest.MonkeyPatch(), number, kill=True)
        try:
            write()
        finally:
            os._exit(0)
    return os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL


KEPT = {}
"""Moments to remove, read before an allocation fails: numba's call for that can crash then."""


def insert(surfel_map, moments, path):
    surfel_map.insert(moments)


def remove(surfel_map, moments, path):
    surfel_map.remove(KEPT[surfel_map.num_voxels])


def load(surfel_map, moments, path):
    loaded, _ = load_map(path)
    assert loaded.digest() == surfel_map.digest()


def read(surfel_map, moments, path):
    assert len(surfel_map.moments()) == surfel_map.num_voxels
    surfel_map.digest()
    surfel_map.surfels_changed(0)


def reduce(surfel_map, moments, path):
    surfel_map.reduce(np.zeros((10, 3)), np.eye(4))


@pytest.mark.parametrize('operation', [insert, remove, load, read, reduce])
def test_an_allocation_that_fails_leaves_the_map_before_or_after(tmp_path, operation):
    testcapi = pytest.importorskip('_testcapi', reason='this Python lacks _testcapi')
    surfel_map, path = map_of(1), tmp_path / 'a.npz'
    save_map(path, surfel_map)
    moments = surfel_map.reduce(np.random.default_rng(3).uniform(-9.0, 9.0, (500, 3)))
    KEPT[surfel_map.num_voxels] = surfel_map.moments()
    after = surfel_map.copy()
    operation(after, moments, path)
    allowed = {surfel_map.digest(), after.digest()}
    failures = 0

    def run():
        operation(surfel_map, moments, path)

    successes = crashes = 0
    sampled = (*range(30), *(30 + 15 * step for step in range(30)))
    for number in count() if EVERY else sampled:
        code = in_child(testcapi, surfel_map, run, number, allowed)
        if EVERY and code == -signal.SIGSEGV:
            crashes += 1
            continue
        assert code in (0, 1), (operation.__name__, number, code)
        failures += code
        successes = 0 if code else successes + 1
        if EVERY and successes == AFTER_LAST:
            break
    print(f'{operation.__name__}: {failures} allocations failed, {crashes} in a call of numba')
    assert failures > 5
    assert crashes <= MOST_CRASHES * failures


def in_child(testcapi, surfel_map, call, number, allowed):
    """Return 0 if a call succeeded, 1 if it raised; 2 for another digest, or a signal negated."""
    child = os.fork()
    if not child:
        code = 3
        try:
            failed = 0
            testcapi.set_nomemory(number, number + 1)
            try:
                call()
            except BaseException:
                failed = 1
            finally:
                testcapi.remove_mem_hooks()
            code = failed if surfel_map.digest() in allowed else 2
        finally:
            os._exit(code)
    status = os.waitpid(child, 0)[1]
    return os.waitstatus_to_exitcode(status)


def test_an_allocation_that_fails_leaves_no_file_beside_the_one_to_be_written(tmp_path):
    """Python creates a file before it allocates the object for it."""
    testcapi = pytest.importorskip('_testcapi', reason='this Python lacks _testcapi')
    path, failures = tmp_path / 'a', 0
    atomic.write_json(path, {})
    for number in range(600):
        testcapi.set_nomemory(number, number + 1)
        try:
            atomic.write_json(path, {'number': 1})
        except Exception:  # Python turns some into a TypeError or RuntimeError
            failures += 1
        finally:
            testcapi.remove_mem_hooks()
        assert [*tmp_path.iterdir()] == [path], number
    assert failures > 20


def test_a_replay_that_cannot_write_once_leaves_the_whole_map_or_none(tmp_path):
    bag = recorded.write_rosbag2(tmp_path / 'bag', recorded.drive())
    with pytest.MonkeyPatch.context() as patch:
        steps = Steps(patch)
        expected = replay(bag, output=tmp_path / 'whole').mapper.map.digest()
    assert load_map(tmp_path / 'whole')[0].digest() == expected
    numbers = range(steps.done) if EVERY else range(0, steps.done, -(-steps.done // 2))
    for number in numbers:
        output = tmp_path / str(number)
        with pytest.MonkeyPatch.context() as patch:
            Steps(patch, number)
            with contextlib.suppress(SurfelMapperError):
                replay(bag, output=output)
        if (output / 'map.npz').is_file():
            assert load_map(output)[0].digest() == expected, number
        assert not [*output.rglob('*.part')], number


def test_a_replay_out_of_memory_once_leaves_the_whole_map_or_none(tmp_path):
    pytest.importorskip('_testcapi', reason='this Python lacks _testcapi')
    bag = recorded.write_rosbag2(tmp_path / 'bag', recorded.drive())
    expected = replay(bag, output=tmp_path / 'whole').mapper.map.digest()
    numbers = (int(1000 * 1.2**power) for power in count())
    failures = 0
    for number in numbers if EVERY else (200_000, 2_000_000):
        output = tmp_path / str(number)
        command = [sys.executable, '-m', 'test.fuzz.allocation', 'one', str(number), bag, output]
        done = subprocess.run([*map(str, command)], capture_output=True, text=True)
        crashed = EVERY and done.returncode == -signal.SIGSEGV  # in numba, see MOST_CRASHES
        assert crashed or done.returncode in (0, 1), (number, done.returncode, done.stderr)
        failures += done.returncode != 0
        if (output / 'map.npz').is_file():
            assert load_map(output)[0].digest() == expected, number
        assert not [*output.rglob('*.part')], number
        if number > LAST_ALLOCATION:
            break
    print(f'replay: {failures} allocations failed')
    assert failures


def test_each_allocation_of_a_replay_up_to_its_map_leaves_a_whole_map_or_none(tmp_path):
    pytest.importorskip('_testcapi', reason='this Python lacks _testcapi')
    scan = recorded.Entries()
    points = np.random.default_rng(1).uniform(-2.0, 2.0, (50, 3))
    scan.cloud('/points', recorded.START_NS, points)
    bag = recorded.write_rosbag2(tmp_path / 'bag', scan)
    first, stride = first_and_stride()
    command = [
        sys.executable,
        '-m',
        'test.fuzz.allocation',
        'until_the_map',
        first,
        stride,
        bag,
        tmp_path,
    ]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True)
    assert not done.returncode, (done.stdout, done.stderr)
    counts = json.loads(done.stdout)
    print(f'replay up to its map: {counts}', done.stderr)
    assert counts['failed'] > 5
    assert len(counts['crashed']) + len(counts['hung']) <= MOST_CRASHES * counts['failed']


def first_and_stride():
    """Return the first allocation of a replay that fails, and the step to the next ones."""
    if not EVERY:
        return 0, SAMPLED
    return (0, 1) if SHARE == 'all' else (int(SHARE) % SHARES, SHARES)


SAMPLED = 2003
"""Stride of the allocations that fail without SURFEL_MAPPER_EVERY_FAILURE."""

LAST_ALLOCATION = 20_000_000
"""More than the allocations of the replay of a small bag with its imports."""
