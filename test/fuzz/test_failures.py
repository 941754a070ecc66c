# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Every step of saving, and allocations of insert, remove and load, fail once in turn.

Afterwards a file has the digest of the old map or of the new one, and a map in memory that of
before or after. A step is an open, write, flush, fsync or rename; it fails with a full disk, or
the process is killed there (SIGKILL). Allocations are those of Python (_testcapi.set_nomemory);
memory that NumPy and kernels get from the system is not among them.

Allocations, steps of a replay, and kills in a writer of many steps are sampled. With
SURFEL_MAPPER_EVERY_FAILURE=all each is tried, but of a whole replay only allocations whose number
is a power of 1.2; that takes an hour. With a number it is one share of SHARES of them, as in
``make fuzz``; of the steps of a writer, which are few, each.
"""

from __future__ import annotations

import contextlib
from importlib.util import find_spec
from itertools import count, islice
import json
import os
import signal
import subprocess
import sys
import traceback

import numpy as np
import pytest

from surfel_mapper import threads as threads_module
from surfel_mapper.errors import FileFormatError, MapLimitError, SurfelMapperError
from surfel_mapper.files import atomic
from surfel_mapper.files.map_state import load_map, save_map
from surfel_mapper.kernels import hashing
from surfel_mapper.mapping import reducer
from surfel_mapper.mapping.storage import HashTable, SEGMENTS
from surfel_mapper.offline.replay import replay
from test.bags import recorded
from test.fuzz.writers import made_columns, map_of, Steps, WRITERS, Written

pytestmark = pytest.mark.skipif(not hasattr(os, 'fork'), reason='needs fork')

SHARE = os.environ.get('SURFEL_MAPPER_EVERY_FAILURE')
EVERY = SHARE is not None

SHARES = 32
"""Shares of the failures: each takes some minutes, most of it for allocations of a replay."""

FEWER = 8
"""Shares of the failures of operations with fewer allocations and steps."""

MOST_CRASHES = 0.01
"""Share of allocations that may end the process: numba does not check those of its dispatcher."""

BATCH = 60
"""Allocations that a process lets fail; a fork takes 50 to 100 ms."""

AFTER_LAST = 50
"""Successes in a row after which an operation is taken to make no more allocations."""


DUMPS = """
import _testcapi, json
for number in 2 * [*range(150)]:
    _testcapi.set_nomemory(number, number + 1)
    try:
        json.dumps({'number': 1}, indent=2)
    except Exception:  # MemoryError, or what Python makes of it; only survival counts
        pass
    finally:
        _testcapi.remove_mem_hooks()
"""


@pytest.fixture(scope='session')
def testcapi():
    """Return the module that lets allocations fail, unless Python ends in a module of its own."""
    module = pytest.importorskip('_testcapi', reason='this Python lacks _testcapi')
    if subprocess.run([sys.executable, '-c', DUMPS], capture_output=True).returncode < 0:
        pytest.skip('this Python itself ends when an allocation of json.dumps fails')
    return module


@pytest.mark.parametrize('name', WRITERS)
def test_a_save_that_fails_at_any_step_leaves_the_old_file_or_the_new(tmp_path, name):
    if name == 'parquet':
        pytest.importorskip('pyarrow')
    file = Written(name, tmp_path / 'a')
    assert file.num_steps >= 5
    for number in range(file.num_steps):
        failed = False
        with pytest.MonkeyPatch.context() as patch:
            Steps(patch, number)
            try:
                file.write_new()
            except FileFormatError:
                failed = True
        file.check(failed, number)
        assert not file.left(), (name, number)


def test_a_save_that_is_killed_at_any_step_leaves_the_old_file_or_the_new(tmp_path):
    command = [sys.executable, '-m', 'test.fuzz.writers', tmp_path, '1' if EVERY else '0']
    done = subprocess.run(command, capture_output=True, text=True)
    assert not done.returncode, done.stderr
    kills = dict(line.rsplit(maxsplit=1) for line in done.stdout.splitlines())
    assert kills.keys() == set(WRITERS) - ({'parquet'} if find_spec('pyarrow') is None else set())
    assert min(map(int, kills.values())) >= 5
    print(f'killed at {sum(map(int, kills.values()))} steps of writing')


KEPT = {}
"""Moments to remove, read before an allocation fails: numba's call for that can crash then."""


def insert(surfel_map, moments, path):
    surfel_map.insert(moments)


def remove(surfel_map, moments, path):
    surfel_map.remove(KEPT[surfel_map.num_voxels])


def remove_in_parts(surfel_map, moments, path):
    surfel_map.remove(moments)


def load(surfel_map, moments, path):
    loaded, _ = load_map(path)
    assert loaded.digest() == surfel_map.digest()


def read(surfel_map, moments, path):
    assert len(surfel_map.moments()) == surfel_map.num_voxels
    surfel_map.digest()
    surfel_map.surfels_changed(0)


def reduce(surfel_map, moments, path):
    points = np.zeros((10, 3))
    surfel_map.reduce(points, np.eye(4), columns=made_columns(points))


@pytest.mark.parametrize('columns', [(), ('intensity', 'rgb')], ids=['plain', 'columns'])
@pytest.mark.parametrize('threads', [1, 2])
@pytest.mark.parametrize('operation', [insert, remove, remove_in_parts, load, read, reduce])
def test_an_allocation_that_fails_leaves_the_map_before_or_after(
    testcapi, tmp_path, monkeypatch, operation, threads, columns
):
    if threads == 2 and operation not in (insert, remove_in_parts):
        pytest.skip('one thread does the work')
    monkeypatch.setattr(reducer, 'LEAST_SHARED', 2)
    monkeypatch.setattr(threads_module, 'pool', lambda _: None)  # a fork has no other thread
    surfel_map, other = map_of(1, columns, threads), map_of(4, columns)
    path = tmp_path / 'a.npz'
    surfel_map.merge(other)
    save_map(path, surfel_map)
    points = np.random.default_rng(3).uniform(-9.0, 9.0, (500, 3))
    moments = surfel_map.reduce(points, columns=made_columns(points))
    assert (moments.stripes is not None) == (threads == 2)
    if operation is remove_in_parts:
        surfel_map.insert(moments)
    KEPT[surfel_map.num_voxels] = other.moments()
    after = surfel_map.copy()
    operation(after, moments, path)
    allowed = {surfel_map.digest(), after.digest()}
    failures = 0

    def operate(changed):
        operation(changed, moments, path)

    successes = crashes = 0
    sampled = (*range(90), *(90 + 15 * step for step in range(30)))
    first, stride = first_and_stride(FEWER)
    numbers = count(first, stride) if EVERY else sampled
    for number, code in results(testcapi, surfel_map, operate, numbers, allowed):
        if EVERY and code == -signal.SIGSEGV:
            crashes += 1
            continue
        assert code in (0, 1), (operation.__name__, number, code)
        failures += code
        successes = 0 if code else successes + 1
        if EVERY and successes >= AFTER_LAST // stride:
            break
    print(f'{operation.__name__}: {failures} allocations failed, {crashes} in a call of numba')
    assert failures > 5
    assert crashes <= max(1, MOST_CRASHES * failures)


def results(testcapi, surfel_map, operate, numbers, allowed):
    """
    Let allocations of an operation fail in turn; yield the number of each with the result.

    0: done all the same, 1: raised, 2: the map is neither that of before, with each voxel in its
    row, nor that of after; a negative number: the signal by which a process died. Each process
    tries a batch, or a part.
    """
    numbers, batch = iter(numbers), []
    while batch := batch + list(islice(numbers, BATCH - len(batch))):
        codes, exit_code = in_child(testcapi, surfel_map, operate, batch, allowed)
        if exit_code:
            codes.append(exit_code)
        yield from zip(batch, codes, strict=False)
        batch = batch[len(codes) :]


def in_child(testcapi, surfel_map, operate, batch, allowed):
    """Return the results of a batch, as far as a forked process came, and its exit code."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        code = 3
        try:
            for number in batch:
                os.write(writing, bytes([result(testcapi, surfel_map, operate, number, allowed)]))
            code = 0
        finally:
            os._exit(code)
    os.close(writing)
    with open(reading, 'rb') as pipe:
        found = list(pipe.read())
    return found, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def result(testcapi, surfel_map, operate, number, allowed):
    """Let an allocation of an operation on a copy of a map fail; see results."""
    changed, failed = surfel_map.copy(), 0
    digest, key = changed.digest(), changed.keys()
    rows = changed.find(key)
    testcapi.set_nomemory(number, number + 1)
    try:
        operate(changed)
    except BaseException:
        failed = 1
    finally:
        testcapi.remove_mem_hooks()
    if changed.digest() not in allowed:
        return 2
    is_moved = changed.digest() == digest and not np.array_equal(changed.find(key), rows)
    return 2 if is_moved else failed


def test_a_hash_table_that_cannot_grow_keeps_arrays_that_fit_together(testcapi):
    def let_each_fail():
        failures = 0
        for number in range(200):
            table = HashTable(max_depth=24)
            for used in (1, SEGMENTS):  # the first time the directory grows, then the segments
                table.state[hashing.NEXT_SEGMENT] = used
                testcapi.set_nomemory(number, number + 1)
                try:
                    table.grow()
                except (MapLimitError, MemoryError):
                    failures += 1
                finally:
                    testcapi.remove_mem_hooks()
                directory, buckets, held, local_depth = table.arrays
                assert len(held) == len(local_depth), number
                assert len(buckets) >= len(held) * hashing.SEGMENT, number
                assert len(directory) == 2 ** table.state[hashing.DEPTH], number
        assert failures > 5

    assert exit_code(let_each_fail) == 0


def test_an_allocation_that_fails_leaves_no_file_beside_the_one_to_be_written(testcapi, tmp_path):
    """Python creates a file before it allocates the object for it."""
    path = tmp_path / 'a'
    atomic.write_json(path, {})

    def let_each_fail():
        failures = 0
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

    assert exit_code(let_each_fail) == 0


def exit_code(check):
    """Run a check in a forked process: after a failed allocation Python may crash anywhere."""
    child = os.fork()
    if not child:
        code = 1
        try:
            check()
            code = 0
        except BaseException:
            traceback.print_exc(file=sys.__stderr__)
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_a_replay_that_cannot_write_once_leaves_the_whole_map_or_none(tmp_path):
    bag = recorded.write_rosbag2(tmp_path / 'bag', recorded.drive())
    with pytest.MonkeyPatch.context() as patch:
        steps = Steps(patch)
        expected = replay(bag, output=tmp_path / 'whole').mapper.map.digest()
    assert load_map(tmp_path / 'whole')[0].digest() == expected
    first, stride = first_and_stride(FEWER) if EVERY else (0, -(-steps.done // 2))
    for number in range(first, steps.done, stride):
        output = tmp_path / str(number)
        with pytest.MonkeyPatch.context() as patch:
            Steps(patch, number)
            with contextlib.suppress(SurfelMapperError):
                replay(bag, output=output)
        if (output / 'map.npz').is_file():
            assert load_map(output)[0].digest() == expected, number
        assert not [*output.rglob('*.part')], number


@pytest.mark.usefixtures('testcapi')
def test_a_replay_out_of_memory_once_leaves_the_whole_map_or_none(tmp_path):
    bag = recorded.write_rosbag2(tmp_path / 'bag', recorded.drive())
    expected = replay(bag, output=tmp_path / 'whole').mapper.map.digest()
    numbers = (int(1000 * 1.2**power) for power in count(*first_and_stride(FEWER)))
    failures = 0
    for number in numbers if EVERY else (200_000, 2_000_000):
        output = tmp_path / str(number)
        command = [sys.executable, '-m', 'test.fuzz.allocation', 'one', str(number), bag, output]
        done = subprocess.run([*map(str, command)], capture_output=True, text=True)
        crashed = EVERY and done.returncode == -signal.SIGSEGV  # in numba, see MOST_CRASHES
        crashed |= 'Python runtime state: finalizing' in done.stderr  # of itself, after the replay
        assert crashed or done.returncode in (0, 1), (number, done.returncode, done.stderr)
        failures += done.returncode != 0
        if (output / 'map.npz').is_file():
            assert load_map(output)[0].digest() == expected, number
        assert not [*output.rglob('*.part')], number
        if number > LAST_ALLOCATION:
            break
    print(f'replay: {failures} allocations failed')
    assert failures


@pytest.mark.usefixtures('testcapi')
def test_each_allocation_of_a_replay_up_to_its_map_leaves_a_whole_map_or_none(tmp_path):
    scan = recorded.Entries()
    points = np.random.default_rng(1).uniform(-2.0, 2.0, (50, 3))
    scan.cloud('/points', recorded.START_NS, points)
    bag = recorded.write_rosbag2(tmp_path / 'bag', scan)
    first, stride = first_and_stride(SHARES)
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
    most = max(1, MOST_CRASHES * counts['failed'])  # one in a sample: libraries crash too
    assert len(counts['crashed']) + len(counts['hung']) <= most


def first_and_stride(shares):
    """Return the first failure of a share, and the step to the next ones."""
    if not EVERY:
        return 0, SAMPLED
    return (0, 1) if SHARE == 'all' else (int(SHARE) % shares, shares)


SAMPLED = 2003
"""Stride of the allocations that fail without SURFEL_MAPPER_EVERY_FAILURE."""

LAST_ALLOCATION = 20_000_000
"""More than the allocations of the replay of a small bag with its imports."""
