# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A save that fails at any of its steps leaves the old file or the new one."""

from __future__ import annotations

import errno
import os

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files import atomic, pcd, ply
from surfel_mapper.files.map_state import save_map
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.simulation.world import World
from test import extras


class Steps:
    """Counts the steps of writing a file, and fails at one of them."""

    def __init__(self, monkeypatch, fail_at=None):
        self.done = 0
        self._fail_at = fail_at
        self._open, self._fsync, self._replace = open, os.fsync, os.replace
        monkeypatch.setattr(atomic, 'open', self.open, raising=False)
        monkeypatch.setattr(atomic.os, 'fsync', self.wrapped(os.fsync))
        monkeypatch.setattr(atomic.os, 'replace', self.wrapped(os.replace))

    def step(self):
        self.done += 1
        if self.done - 1 == self._fail_at:
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
    extras.load('pyarrow')
    from surfel_mapper.files.parquet import write_map

    write_map(path, surfel_map)


WRITERS = {
    'npz': save_map,
    'npz packed': lambda path, surfel_map: save_map(path, surfel_map, compress=True),
    'parquet': write_parquet,
    'ply': lambda path, surfel_map: ply.write_surfels(path, surfel_map.surfels()),
    'pcd': lambda path, surfel_map: pcd.write_surfels(path, surfel_map.surfels()),
    'world': lambda path, surfel_map: World(
        [], (*surfel_map.surfels().position[0], 0.0, 0.0, 0.0, 1.0)
    ).save(path),
    'json': lambda path, surfel_map: atomic.write_json(path, {'digest': surfel_map.digest()}),
}


class Written:
    """A file that holds one map, and is to hold another."""

    def __init__(self, name, path):
        """Write both; the file holds the first at the end."""
        self.path = path
        self._write, self._old, self._new = WRITERS[name], map_of(1), map_of(2)
        self.write_new()
        self.new_bytes = path.read_bytes()
        self.write_old()
        self.old_bytes = path.read_bytes()
        with pytest.MonkeyPatch.context() as patch:
            steps = Steps(patch)
            self.write_old()
        self.num_steps = steps.done

    def write_old(self):
        self._write(self.path, self._old)

    def write_new(self):
        self._write(self.path, self._new)

    def check(self, has_failed, number):
        """Check that the file is the old one or the new one, and make it the old one again."""
        found = self.path.read_bytes()
        assert found in (self.old_bytes, self.new_bytes), (self.path, number)
        # the sync of the directory may fail when the file is replaced
        assert has_failed or found == self.new_bytes, (self.path, number)
        self.write_old()

    def left(self):
        """Return the other files of the folder."""
        return [file for file in self.path.parent.iterdir() if file != self.path]


@pytest.mark.parametrize('name', WRITERS)
def test_a_save_that_fails_at_any_step_leaves_the_old_file_or_the_new(tmp_path, name):
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
