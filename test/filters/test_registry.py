# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Registration and look-up of filters: either name, decorator, entry point, refusals."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from surfel_mapper import filters
from surfel_mapper.errors import ConfigError
from surfel_mapper.filters import parameter, registry
from surfel_mapper.filters.base import Filter, FiniteFilter
from surfel_mapper.filters.chain import Chain
from surfel_mapper.filters.grids import VoxelGrid
from surfel_mapper.filters.registry import all_filters, find, register
from test.filters.examples import scan_of

pytestmark = pytest.mark.usefixtures('own_registry')


@dataclass(frozen=True, slots=True, kw_only=True)
class OddRows(Filter):
    """Keep every second point."""

    phase: int = parameter(1, 'First point that stays.', low=0, high=1)

    def keep(self, scan):
        return np.arange(len(scan)) % 2 == self.phase


class Broken:
    """No filter."""


def entry_points(monkeypatch, **values):
    points = [EntryPoint(name, value, registry.GROUP) for name, value in values.items()]

    def found(group, name=None):
        return [p for p in points if p.group == group and name in (None, p.name)]

    monkeypatch.setattr(registry, 'entry_points', found)


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(ConfigError, match=r'voxelgrid: no such filter, .*did you mean voxel_grid'):
        find('voxelgrid')
    with pytest.raises(ConfigError, match='did you mean VoxelGridDataPointsFilter'):
        find('VoxelGridDataPointFilter')


def test_a_decorated_class_is_found_under_its_name_in_snake_case():
    register(OddRows)
    assert find('odd_rows') is OddRows
    assert OddRows in all_filters()
    scan = Chain.from_list([{'odd_rows': {'phase': '0'}}]).apply(scan_of(np.zeros((5, 3))))
    assert len(scan) == 3


def test_a_name_can_be_given_and_taken_once():
    register(name='odd', libpointmatcher='OddDataPointsFilter')(OddRows)
    assert find('odd') is find('OddDataPointsFilter') is OddRows
    with pytest.raises(ConfigError, match=r"filter 'voxel_grid' of .*: .*grids has one of"):
        register(name='voxel_grid')(OddRows)
    with pytest.raises(ConfigError, match='expected a class derived from'):
        register(Broken)


def test_a_filter_that_filters_nothing_is_refused():
    for base in (Filter, FiniteFilter):
        with pytest.raises(ConfigError, match='Idle: a filter has to implement keep or apply'):
            register(type('Idle', (base,), {}))


def test_the_package_exports_every_filter():
    exported = {name: getattr(filters, name) for name in filters.__all__}
    built_in = [c for c in all_filters() if c.__module__.startswith('surfel_mapper.filters.')]
    assert [cls.__name__ for cls in built_in if exported.get(cls.__name__) is not cls] == []


def test_a_broken_entry_point_affects_only_chains_that_use_it(monkeypatch, caplog):
    entry_points(monkeypatch, lost='no_such_package:Filter', none=f'{__name__}:Broken')
    assert find('voxel_grid') is VoxelGrid
    assert VoxelGrid in all_filters()
    assert 'no_such_package:Filter does not load' in caplog.text
    with pytest.raises(ConfigError, match="'lost': entry point no_such_package:Filter does not"):
        find('lost')
    with pytest.raises(ConfigError, match='expected a class derived from'):
        find('none')
    with pytest.raises(ConfigError, match='did you mean lost'):
        find('losst')


def test_filters_are_listed_sorted_and_once_each():
    names = [cls.name for cls in all_filters()]
    assert names == sorted(set(names))
    assert len([cls for cls in all_filters() if cls.libpointmatcher]) == 31
