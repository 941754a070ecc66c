# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Moments of points are possible; moments beyond a bound, one at a time, are found."""

import numpy as np
import pytest

from surfel_mapper.kernels.layout import HALF, VIEW_SCALE
from surfel_mapper.mapping.moments import impossible, ScanMoments

SQUARES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def moments_of(level, seed=1, num_voxels=20):
    """Return key, count, total, product and view, summed point by point in Python's integers."""
    rng = np.random.default_rng(seed)
    half = HALF << level
    columns = [[], [], [], [], []]
    for row in range(num_voxels):
        points = rng.integers(-half, half, (int(rng.integers(1, 30)), 3)).tolist()
        if row == 0:  # all in the farthest corner, which is on two bounds
            points = [[-half] * 3] * 5
        columns[0].append(int(rng.integers(0, 2**63)))
        columns[1].append(len(points))
        columns[2].append([sum(p[a] for p in points) for a in range(3)])
        columns[3].append([sum(p[a] * p[b] for p in points) for a, b in SQUARES])
        columns[4].append(rng.integers(-VIEW_SCALE, VIEW_SCALE + 1, 3).tolist())
    return [np.array(column, np.int64) for column in columns]


def impossible_rows(arrays, level, *, views_are_sums=False):
    """Return the rows of some arrays that no points can have."""
    key, count, total, product, view = arrays
    moments = ScanMoments(
        voxel_size_m=0.5,
        level=level,
        key=key,
        count=count,
        total=total,
        product=product,
        view=view if views_are_sums else view.astype(np.int16),
    )
    return np.flatnonzero(impossible(moments)).tolist()


@pytest.mark.parametrize('level', [0, 1, 3])
def test_moments_of_points_are_possible(level):
    assert impossible_rows(moments_of(level), level) == []


@pytest.mark.parametrize('level', [0, 2])
def test_moments_beyond_a_bound_are_found(level):
    half, row = HALF << level, 7
    number, axis = int(moments_of(level)[1][row]), 1
    square = [0, 3, 5][axis]
    changes = {
        'key below 0': (0, (), -1),
        'no points': (1, (), 0),
        'a negative count': (1, (), -3),
        'a mean outside the voxel': (2, axis, number * half + 1),
        'a second moment outside the voxel': (3, square, int(1.01 * number * half * half)),
        'a sum too large for its second moment': (3, square, 0),
        'a negative second moment': (3, square, -1),
        'a view longer than its unit': (4, axis, VIEW_SCALE + 2),
    }
    for name, (column, place, value) in changes.items():
        moments = moments_of(level)
        if place == ():
            moments[column][row] = value
        else:
            moments[column][row, place] = value
        assert impossible_rows(moments, level) == [row], name


def test_summed_views_are_bounded_by_the_count():
    moments = moments_of(0)
    moments[4][3] = VIEW_SCALE * moments[1][3]
    assert impossible_rows(moments, 0, views_are_sums=True) == []
    moments[4][3] += 2
    assert impossible_rows(moments, 0, views_are_sums=True) == [3]
