# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Errors that no stage expects: they cost one scan or one layer, are counted, and mapping goes on.

Every stage fails in turn, out of memory or by a bug, between scans that do not fail; the map then
equals the one of the scans that were mapped.
"""

from __future__ import annotations

import logging

import numpy as np
import pytest

from surfel_mapper import layers
from surfel_mapper.errors import AlignmentError, CloudFormatError, MapError
from surfel_mapper.files.map_state import load_map
from surfel_mapper.layers import Layer
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow
from surfel_mapper.pipeline.loop_closer import LoopCloser
from surfel_mapper.pipeline.preparation import Preparation
from surfel_mapper.pipeline.saved_state import save_mapper
from test.pipeline.made_scans import add_pose, assert_counts_add_up, insert, mapper_with, scan_at

ERRORS = [MemoryError(), ZeroDivisionError('division by zero')]
BEFORE = {
    'prepare': (Preparation, 'prepare'),
    'reduce': (SurfelMap, 'reduce'),
    'window': (SlidingWindow, 'insert'),
    'map': (SurfelMap, 'insert'),
}


def fail_once(monkeypatch, cls, name, error):
    """Make the next call of a method raise an error."""
    work = getattr(cls, name)

    def failing(self, *args, **kwargs):
        monkeypatch.setattr(cls, name, work)
        raise error

    monkeypatch.setattr(cls, name, failing)


def drive(mapper, *stamps_s):
    for stamp_s in stamps_s:
        add_pose(mapper, stamp_s, x=stamp_s)
    return insert(mapper, *map(scan_at, stamps_s))


@pytest.mark.parametrize('stage', BEFORE)
@pytest.mark.parametrize('error', ERRORS, ids=lambda error: type(error).__name__)
def test_a_failure_before_the_map_costs_one_scan(monkeypatch, caplog, stage, error):
    mapper, expected = mapper_with(window__max_scans=3), mapper_with(window__max_scans=3)
    drive(mapper, 1.0, 2.0)
    fail_once(monkeypatch, *BEFORE[stage], error)
    assert drive(mapper, 3.0) == []
    assert len(drive(mapper, 4.0, 5.0, 6.0)) == 3

    drive(expected, 1.0, 2.0, 4.0, 5.0, 6.0)
    assert mapper.map.digest() == expected.map.digest()
    assert mapper.counters.dropped == {'internal_error': 1}
    assert type(error).__name__ in caplog.text
    assert_counts_add_up(mapper)


class Busy(Layer):
    """A layer that takes part in both tasks of a scan."""

    name = 'busy'

    def voxels_to_clear(self, inserted):
        return np.empty((0, 3), np.int32)

    def follow(self, inserted):
        return inserted.num_points


@pytest.fixture
def busy():
    layers.register('busy', f'{__name__}:Busy')
    yield
    layers.unregister('busy')


def test_a_scan_that_loops_cannot_keep_is_mapped_and_loops_are_off(monkeypatch, caplog):
    mapper = mapper_with(loops__enabled=True)
    drive(mapper, 1.0)
    fail_once(monkeypatch, LoopCloser, 'add', MemoryError())
    updates = drive(mapper, 2.0, 3.0)
    assert [update.stamp_ns // 10**9 for update in updates] == [2, 3]
    assert mapper.counters.mapped == 3
    assert mapper.counters.dropped == {}
    assert 'MemoryError; loops are not closed' in caplog.text
    with pytest.raises(AlignmentError, match=r'loops\.enabled'):
        mapper.close_loops()


class Fragile(Layer):
    """A layer that raises an error given from outside, and notes the stamps that it took."""

    name = 'fragile'
    error: Exception | None = None

    def __init__(self, config, around):
        super().__init__(config, around)
        self.stamps = []

    def follow(self, inserted):
        if Fragile.error is not None:
            raise Fragile.error
        self.stamps.append(inserted.scan.stamp_ns // 10**9)
        return len(self.stamps)

    def clear(self):
        self.stamps.clear()


@pytest.fixture
def fragile():
    layers.register('fragile', f'{__name__}:Fragile')
    yield Fragile
    Fragile.error = None
    layers.unregister('fragile')


@pytest.mark.parametrize(
    'error', [*ERRORS, MapError('full')], ids=lambda error: type(error).__name__
)
def test_a_layer_that_fails_three_times_in_a_row_is_switched_off(fragile, caplog, error):
    mapper = mapper_with()
    drive(mapper, 1.0)
    fragile.error = error
    updates = drive(mapper, 2.0, 3.0)
    fragile.error = None
    updates += drive(mapper, 4.0)
    assert not mapper.counters.layers_off  # two in a row may come
    fragile.error = error
    drive(mapper, 5.0, 6.0)
    with caplog.at_level(logging.ERROR):
        drive(mapper, 7.0)
    fragile.error = None
    (update,) = drive(mapper, 8.0)

    assert [update.fragile for update in updates] == [None, None, 2]
    assert update.fragile is None
    assert mapper.fragile.stamps == [1, 4]
    assert mapper.counters.mapped == 8
    assert mapper.counters.messages_ignored == {'fragile': 5}
    assert list(mapper.summary()['layers_off']) == ['fragile']
    assert 'layer fragile is switched off' in caplog.text

    mapper.clear()
    (update,) = drive(mapper, 9.0)
    assert update.fragile == 1
    assert 'layers_off' not in mapper.summary()


def switched_off(fragile, mapper):
    fragile.error = RuntimeError('broken')
    drive(mapper, 1.0, 2.0, 3.0)
    fragile.error = None
    assert 'fragile' in mapper.counters.layers_off


@pytest.mark.parametrize('name', ['finish', 'summary'])
def test_a_layer_that_fails_at_the_end_does_not_cost_the_map(fragile, monkeypatch, name):
    """A replay ended there, before it wrote the map."""

    def broken(self):
        raise MemoryError

    monkeypatch.setattr(fragile, name, broken)
    mapper = mapper_with()
    drive(mapper, 1.0)
    mapper.finish_layers()
    assert 'fragile' not in mapper.summary()
    assert mapper.counters.messages_ignored == {'internal_error': 1}


def test_a_layer_that_is_off_does_not_keep_the_map_from_being_saved(
    fragile, monkeypatch, tmp_path, caplog
):
    def save(self, path):
        assert not self.is_broken, 'a state that cannot be written'
        path.write_bytes(b'a state')

    monkeypatch.setattr(fragile, 'save', save)
    monkeypatch.setattr(fragile, 'is_broken', False, raising=False)
    mapper, path = mapper_with(), tmp_path / 'map.npz'
    drive(mapper, 0.5)
    save_mapper(path, mapper)
    file = tmp_path / 'map.fragile.npz'
    assert file.is_file()

    fragile.is_broken = True
    switched_off(fragile, mapper)
    assert save_mapper(path, mapper) == mapper.map.digest()
    assert load_map(path)[0].digest() == mapper.map.digest()
    assert not file.exists()  # it belonged to the map before
    assert 'layer fragile is off: ' in caplog.text


def test_scans_that_a_layer_cannot_use_do_not_switch_it_off(fragile):
    mapper = mapper_with()
    fragile.error = CloudFormatError('no lidar')
    drive(mapper, 1.0, 2.0, 3.0, 4.0)
    fragile.error = None
    (update,) = drive(mapper, 5.0)
    assert update.fragile == 1
