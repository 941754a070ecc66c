# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""SurfelMap.origin_m: maps of different origins merge exactly, files have outer coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper import SurfelMap
from surfel_mapper.errors import MapError, MapLimitError
from surfel_mapper.files import parquet
from surfel_mapper.files.map_state import load_map, save_map
from test import extras

UTM = np.array([400_000.0, 5_400_000.0, 250.0])


def dyadic_points(seed=1, number=3000):
    rng = np.random.default_rng(seed)
    return np.round(rng.uniform(-40.0, 40.0, (number, 3)) * 1024) / 1024


def map_at(origin, points=None, seed=1):
    surfel_map = SurfelMap(0.5, origin_m=origin)
    points = dyadic_points(seed) if points is None else points
    surfel_map.add(points, origin=[1.0, 2.0, 3.0])
    return surfel_map


def test_maps_of_two_origins_merge_as_those_of_one():
    apart = np.array([512.0, -1024.0, 0.5])
    one, two = dyadic_points(1), dyadic_points(2)
    expected = SurfelMap(0.5, origin_m=UTM)
    expected.add(one)
    expected.add(two + apart)  # the same places from the first origin
    first, second = SurfelMap(0.5, origin_m=UTM), SurfelMap(0.5, origin_m=UTM + apart)
    first.add(one)
    second.add(two)

    first.merge(second)

    assert first == expected
    first.subtract(second)
    alone = SurfelMap(0.5, origin_m=UTM)
    alone.add(one)
    assert first == alone


def test_a_map_at_another_origin_has_the_same_points():
    surfel_map = map_at(UTM)
    moved = surfel_map.at_origin(UTM - [64.0, 0.0, 32.0])

    def outer(each):
        surfels = each.surfels()
        places = surfels.position + each.origin_m
        return places[np.lexsort(places.T)]

    np.testing.assert_allclose(outer(moved), outer(surfel_map), rtol=0, atol=1e-9)
    assert moved.at_origin(UTM) == surfel_map
    assert moved != surfel_map


def test_the_digest_does_not_depend_on_the_origin_and_copies_keep_it():
    surfel_map = map_at(UTM)
    assert surfel_map.digest() == map_at((0, 0, 0)).digest()
    assert surfel_map != map_at((0, 0, 0))
    np.testing.assert_array_equal(surfel_map.copy().origin_m, UTM)
    np.testing.assert_array_equal(surfel_map.coarsen(2).origin_m, UTM)


def test_origins_that_are_not_whole_voxels_apart_are_refused():
    with pytest.raises(MapError, match=r'a whole number of voxels of 0\.5 m'):
        map_at(UTM).merge(map_at(UTM + 0.2))
    with pytest.raises(MapLimitError, match='use larger voxels'):
        map_at(UTM).merge(map_at((0.0, 0.0, 0.0)))
    for origin in ([1.0, 2.0], [np.nan, 0.0, 0.0]):
        with pytest.raises(ValueError, match='origin_m'):
            SurfelMap(0.5, origin_m=origin)


def test_state_and_parquet_keep_the_origin(tmp_path):
    surfel_map = map_at(UTM)
    save_map(tmp_path / 'map.npz', surfel_map)
    assert load_map(tmp_path / 'map.npz')[0] == surfel_map
    extras.load('pyarrow')
    parquet.write_map(tmp_path / 'map.parquet', surfel_map)
    assert parquet.read_map(tmp_path / 'map.parquet') == surfel_map
    from pyarrow.parquet import read_table

    table = read_table(tmp_path / 'map.parquet')
    places = np.stack([table.column(axis).to_numpy() for axis in 'xyz'], axis=1)
    keys = np.stack([table.column(axis).to_numpy() for axis in 'ijk'], axis=1)
    assert (np.floor((places - UTM) / 0.5) == keys).all()
