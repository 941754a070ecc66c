# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Checkpoints: when they are written, which one a restart finds, and what damage costs."""

from __future__ import annotations

import logging
import os
import time

import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.map_state import load_map
from surfel_mapper.files.parquet_tiles import write_tiles
from surfel_mapper.pipeline import checkpoints, saved_state
from surfel_mapper.pipeline.checkpoints import checkpoint_path, Checkpoints, load_start
from surfel_mapper.pipeline.saved_state import save_mapper
from test import extras
from test.pipeline.made_scans import add_pose, insert, mapper_with, scan_at


class Clock:
    """The steady clock of the module, set by hand."""

    now_s = 100.0

    def monotonic(self):
        return self.now_s

    def time(self):
        return time.time() + 1000.0


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(checkpoints, 'time', clock)
    return clock


def mapper_in(folder, **changes):
    changes = {'window__max_scans': 3, 'output__checkpoint_s': 10.0, **changes}
    return mapper_with(output__directory=str(folder), **changes)


def drive(mapper, *stamps_s):
    for stamp_s in stamps_s:
        add_pose(mapper, stamp_s, x=stamp_s)
        insert(mapper, scan_at(stamp_s))


def test_a_checkpoint_is_written_when_due_and_replaces_the_one_before(tmp_path, clock):
    mapper = mapper_in(tmp_path)
    saving, path = Checkpoints(mapper), checkpoint_path(mapper.config.output)
    drive(mapper, 1.0)
    assert saving.save_if_due() is None
    for stamp_s in (2.0, 3.0, 4.0):
        clock.now_s += 10.0
        drive(mapper, stamp_s)
        assert saving.save_if_due() == path
        assert saving.save_if_due() is None
    clock.now_s += 10.0
    assert saving.save_if_due() is None  # the map is as it was
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert load_map(path)[0].digest() == mapper.map.digest()


def test_latest_continues_with_map_and_window(tmp_path, clock):
    mapper = mapper_in(tmp_path)
    saving = Checkpoints(mapper)
    drive(mapper, 1.0, 2.0, 3.0, 4.0)
    clock.now_s += 10.0
    assert saving.save_if_due() is not None
    after = mapper_in(tmp_path, map__load='latest')
    load_start(after)
    assert after.map.digest() == mapper.map.digest()
    for each in (mapper, after):
        drive(each, 5.0, 6.0)
    assert after.map.digest() == mapper.map.digest()  # the same scans have left


@pytest.mark.parametrize('is_damaged', [False, True])
@pytest.mark.parametrize('is_newer', [False, True])
def test_latest_is_the_newer_file_that_is_whole(tmp_path, clock, caplog, is_newer, is_damaged):
    mapper = mapper_in(tmp_path)
    path = checkpoint_path(mapper.config.output)
    saved = tmp_path / f'{mapper.config.output.map_name}.npz'
    drive(mapper, 1.0)
    saved_digest = save_mapper(saved, mapper)
    drive(mapper, 2.0)
    Checkpoints(mapper).save()
    at_s = saved.stat().st_mtime + (10.0 if is_newer else -10.0)
    os.utime(path, (at_s, at_s))
    newest = path if is_newer else saved
    if is_damaged:
        newest.write_bytes(newest.read_bytes()[:-100])
        os.utime(newest, (at_s + 20.0, at_s + 20.0))
    after = mapper_in(tmp_path, map__load='latest')
    load_start(after)
    expected = mapper.map.digest() if is_newer != is_damaged else saved_digest
    assert after.map.digest() == expected
    assert ('an older one is tried' in caplog.text) == is_damaged


def test_a_map_in_tiles_is_a_start_too(tmp_path):
    extras.load('pyarrow')
    mapper = mapper_in(tmp_path)
    drive(mapper, 1.0, 2.0)
    write_tiles(tmp_path / 'tiled' / 'map', mapper.map)
    after = mapper_in(tmp_path, map__load=str(tmp_path / 'tiled'))
    load_start(after)
    assert after.map.digest() == mapper.map.digest()


def test_latest_without_any_map_starts_empty(tmp_path, caplog):
    mapper = mapper_in(tmp_path, map__load='latest')
    with caplog.at_level(logging.WARNING):
        load_start(mapper)
    assert mapper.map.num_voxels == 0
    assert 'no map in' in caplog.text


def test_a_checkpoint_that_cannot_be_written_leaves_the_one_before(tmp_path, clock, monkeypatch):
    mapper = mapper_in(tmp_path)
    saving, path = Checkpoints(mapper), checkpoint_path(mapper.config.output)
    drive(mapper, 1.0)
    clock.now_s += 10.0
    saving.save_if_due()
    digest = mapper.map.digest()

    def fail(*args):
        raise FileFormatError('no space')

    monkeypatch.setattr(saved_state, 'save_map', fail)
    for _ in range(3):
        drive(mapper, 2.0 + clock.now_s)
        clock.now_s += 10.0
        with pytest.raises(FileFormatError):
            saving.save_if_due()
    assert load_map(path)[0].digest() == digest
    assert saving.problem.startswith('checkpoints fail (FileFormatError: no space); the last good')
    assert int(saving.problem.split()[-3]) in range(999, 1600)  # the clock is 1000 s ahead

    monkeypatch.undo()
    saving.save()
    assert saving.problem == ''


def test_a_checkpoint_is_not_written_through_a_link(tmp_path, clock):
    mapper = mapper_in(tmp_path)
    checkpoint_path(mapper.config.output).symlink_to(tmp_path / 'elsewhere')
    saving = Checkpoints(mapper)
    drive(mapper, 1.0)
    clock.now_s += 10.0
    with pytest.raises(FileFormatError, match='a link'):
        saving.save_if_due()


def test_the_oldest_scans_leave_beyond_the_bytes_of_the_map():
    mapper = mapper_with(map__max_bytes=30_000)
    drive(mapper, *(float(k) for k in range(1, 31)))
    assert 160 * mapper.map.num_voxels + mapper.window.nbytes <= 30_000
    assert 0 < len(mapper.window) < 30
    assert mapper.counters.evicted['max_total_bytes'] == 30 - len(mapper.window)
    expected = mapper_with()
    drive(expected, *(scan.stamp_ns / 1e9 for scan in mapper.window))
    assert mapper.map.digest() == expected.map.digest()


def test_a_file_in_place_of_the_directory_is_reported(tmp_path, clock):
    (tmp_path / 'maps').write_bytes(b'')
    mapper = mapper_in(tmp_path / 'maps' / 'robot')
    drive(mapper, 1.0)
    clock.now_s += 11.0
    said = f'{tmp_path}/maps/robot: {tmp_path}/maps is a file, expected a directory'
    with pytest.raises(FileFormatError, match=f'^{said}$'):
        Checkpoints(mapper).save()
