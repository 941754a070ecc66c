# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Intensity and colour of a map: exact sums, exact removal, correct means."""

from __future__ import annotations

from collections import defaultdict
import re

import numpy as np
import pytest

from surfel_mapper.errors import MapError
from surfel_mapper.mapping.surfel_map import SurfelMap

COLUMNS = ('intensity', 'rgb')


def packed(colors):
    """Return colours (N, 3) uint8 as PCL packs them: three bytes of a float32."""
    red, green, blue = colors.astype(np.uint32).T
    return ((red << 16) | (green << 8) | blue).view(np.float32)


def coloured(seed, num=2000):
    rng = np.random.default_rng(seed)
    colors = rng.integers(0, 256, (num, 3)).astype(np.uint8)
    columns = {'intensity': rng.integers(0, 4096, num) / 16.0, 'rgb': packed(colors)}
    return rng.uniform(-2.0, 2.0, (num, 3)), columns, colors


def test_means_are_those_of_the_points_of_each_voxel():
    points, columns, colors = coloured(0)
    surfel_map = SurfelMap(0.5, columns=COLUMNS)
    surfel_map.add(points, columns=columns)
    members = defaultdict(list)
    for row, voxel in enumerate(np.floor(points / 0.5).astype(int).tolist()):
        members[tuple(voxel)].append(row)

    surfels = surfel_map.surfels()

    assert len(surfels) == len(members)
    for row, voxel in enumerate(surfels.voxel_index.tolist()):
        rows = members[tuple(voxel)]
        expected = columns['intensity'][rows].mean()  # sixteenths: no rounding to 1/256
        assert surfels.channels['intensity'][row] == pytest.approx(expected, rel=1e-14)
        for channel, name in enumerate(('red', 'green', 'blue')):
            expected = colors[rows, channel].mean()
            assert surfels.channels[name][row] == pytest.approx(expected, rel=1e-14)


def test_removing_a_scan_leaves_no_trace_in_the_channels():
    surfel_map, expected = SurfelMap(0.5, columns=COLUMNS), SurfelMap(0.5, columns=COLUMNS)
    (stays, stay_columns, _), (leaves, leave_columns, _) = coloured(1), coloured(2)
    expected.add(stays, columns=stay_columns)

    moments = surfel_map.add(leaves, columns=leave_columns)
    surfel_map.add(stays, columns=stay_columns)
    surfel_map.remove(moments)

    assert surfel_map == expected
    assert surfel_map.coarsen(1) == expected.coarsen(1)
    surfel_map.subtract(expected)
    surfel_map.add(stays, columns=stay_columns)  # in rows that were used before
    assert surfel_map == expected


def test_the_digest_tells_maps_apart_that_differ_in_a_colour_alone():
    points, columns, _ = coloured(3)
    other = {**columns, 'intensity': columns['intensity'] + (np.arange(len(points)) == 7)}
    one, two = SurfelMap(0.5, columns=COLUMNS), SurfelMap(0.5, columns=COLUMNS)
    one.add(points, columns=columns)
    two.add(points, columns=other)
    assert one != two


def test_values_of_rejected_points_are_not_summed():
    points = np.array([[0.1, 0.1, 0.1], [np.nan, 0.0, 0.0], [0.2, 0.1, 0.1]])
    surfel_map = SurfelMap(0.5, columns=('intensity',))
    surfel_map.add(points, columns={'intensity': np.array([1.0, 100.0, 3.0])})
    assert surfel_map.surfels().channels['intensity'].tolist() == [2.0]


def test_colours_may_be_packed_into_integers_or_lie_side_by_side():
    points, columns, colors = coloured(5)
    expected = SurfelMap(0.5, columns=('rgb',))
    expected.add(points, columns=columns)
    for column in (columns['rgb'].view(np.uint32), colors):
        surfel_map = SurfelMap(0.5, columns=('rgb',))
        surfel_map.add(points, columns={'rgb': column})
        assert surfel_map == expected
    surfel_map = SurfelMap(0.5, columns=('rgb',))
    surfel_map.add(points, columns={'rgba': columns['rgb'].view(np.uint32)})
    assert surfel_map == expected


@pytest.mark.parametrize('names', ['rgb', ('red', 'green', 'blue'), 'RGB'])
@pytest.mark.parametrize(('dtype', 'top'), [('u1', 255), ('f4', 255), ('f4', 1), ('u2', 65535)])
def test_colours_may_be_three_columns(names, dtype, top):
    points, columns, colors = coloured(5)
    expected, surfel_map = SurfelMap(0.5, columns=('rgb',)), SurfelMap(0.5, columns=('rgb',))
    expected.add(points, columns=columns)
    channels = (colors.astype(np.float64) * (top / 255)).astype(dtype)
    surfel_map.add(points, columns=dict(zip(names, channels.T, strict=True)))
    assert surfel_map == expected


def test_a_missing_or_short_column_is_refused_and_changes_nothing():
    surfel_map = SurfelMap(0.5, columns=('intensity',))
    with pytest.raises(ValueError, match='column intensity: missing'):
        surfel_map.add(np.zeros((3, 3)))
    with pytest.raises(ValueError, match='of length 2, expected one row for 3 points'):
        surfel_map.add(np.zeros((3, 3)), columns={'intensity': np.zeros(2)})
    assert surfel_map.num_points == 0


@pytest.mark.parametrize(
    ('name', 'shape', 'expected'),
    [
        ('intensity', (3, 1), r'(3,)'),
        ('intensity', (3, 2), r'(3,)'),
        ('rgb', (3, 2), r'(3,) packed, or (3, 3)'),
        ('rgb', (3, 3, 1), r'(3,) packed, or (3, 3)'),
    ],
)
def test_a_column_of_another_shape_is_refused_and_changes_nothing(name, shape, expected):
    surfel_map = SurfelMap(0.5, columns=(name,))
    match = re.escape(f'column {name}: shape {shape}, expected {expected}')
    with pytest.raises(ValueError, match=match):
        surfel_map.add(np.zeros((3, 3)), columns={name: np.zeros(shape)})
    assert surfel_map.num_points == 0


def test_colours_may_have_an_opacity():
    points, _, colors = coloured(6)
    expected, surfel_map = SurfelMap(0.5, columns=('rgb',)), SurfelMap(0.5, columns=('rgb',))
    expected.add(points, columns={'rgb': colors})
    opacity = np.full((len(points), 1), 255, np.uint8)
    surfel_map.add(points, columns={'rgba': np.hstack([colors, opacity])})
    assert surfel_map == expected


def test_maps_with_other_columns_do_not_mix():
    with pytest.raises(MapError, match='channels'):
        SurfelMap(0.5, columns=('intensity',)).merge(SurfelMap(0.5))
    with pytest.raises(ValueError, match='columns'):
        SurfelMap(0.5, columns=('ring',))
