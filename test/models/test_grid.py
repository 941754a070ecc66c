# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Coverage of patches: cells, boundary and cuts against slow twins and true areas."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models import fit
from surfel_mapper.models.grid import Cells
from test.models.scenes import A, room, sheet, VIEW

PITCH = 3 * A


def shape(inside, size=2.0):
    """Return the points of a fine sheet that are inside a shape."""
    points = sheet(size, size, A / 2)
    return points[inside(points[:, 0], points[:, 1])]


SHAPES = {
    'square': (lambda x, y: np.maximum(abs(x), abs(y)) < 0.9, 3.24, 7.2),
    'L': (lambda x, y: (np.maximum(abs(x), abs(y)) < 0.9) & ((x < 0.0) | (y < 0.0)), 2.43, 7.2),
    'annulus': (lambda x, y: (x * x + y * y < 0.81) & (x * x + y * y > 0.16), 2.042, 8.17),
    'triangle': (lambda x, y: (x > -0.9) & (y > -0.9) & (x + y < 0.0), 1.62, 6.15),
}


@pytest.mark.parametrize('name', SHAPES)
def test_area_equals_the_shape_within_one_and_a_half_cells_of_boundary(name):
    inside, area, perimeter = SHAPES[name]
    (plane,) = fit(shape(inside), ModelsConfig(voxel_size_m=A), (0, 0, 5)).planes
    assert plane.grid.area_m2() == pytest.approx(area, abs=0.75 * perimeter * PITCH)


@pytest.mark.parametrize('profile', ['robust', 'paper'])
def test_patch_covers_all_its_points(profile):
    points, _ = room(160, 120)
    config = ModelsConfig(voxel_size_m=A, profile=profile)
    model = fit(points, config, VIEW)
    # a cloud of voxel means goes through unchanged, so its labels are those of the means
    means = fitted_points(points)
    again = fit(means, config, VIEW)
    assert model.patches
    for patch in again.patches:
        own = means[again.labels == patch.id]
        assert patch.grid.contains(patch.to_local(own)[:, :2]).all()


def fitted_points(points):
    """Return points, one a voxel, in the middle of it: thinning leaves them as they are."""
    return np.unique(np.floor(points.astype(np.float64) / A), axis=0) * A + A / 2


def test_cells_and_boundary_equal_the_slow_twin():
    cloud = fitted_points(shape(SHAPES['annulus'][0]))
    (plane,) = fit(cloud, ModelsConfig(voxel_size_m=A), (0, 0, 5)).planes
    grid, xy = plane.grid, plane.to_local(cloud)[:, :2]
    filled = np.zeros_like(grid.filled)
    for x, y in xy:
        filled[int((x - grid.origin[0]) / PITCH), int((y - grid.origin[1]) / PITCH)] = True
    assert (grid.filled == filled).all()
    for (i, j), is_rim in np.ndenumerate(grid.rim):
        around = [(i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)]
        alone = any(
            not (0 <= x < filled.shape[0] and 0 <= y < filled.shape[1] and filled[x, y])
            for x, y in around
        )
        assert is_rim == (filled[i, j] and alone)


def slow_contains(grid, xy):
    """Return the same a step of all places at a time."""
    cell = np.floor((xy - grid.origin) / grid.pitch_m).astype(np.int64)
    # the last point of a grid may stand on its end
    on_end = (xy - grid.origin) <= np.array(grid.filled.shape) * grid.pitch_m
    last = np.array(grid.filled.shape) - 1
    cell = np.where(on_end, np.minimum(cell, last), cell)
    inside = np.all((cell >= 0) & (cell <= last), axis=1)
    x, y = np.clip(cell, 0, last).T
    inside &= grid.filled[x, y]
    corner = grid.corner[x, y]
    from_x = np.abs(xy[:, 0] - grid.origin[0] - (x + (corner & 1)) * grid.pitch_m)
    from_y = np.abs(xy[:, 1] - grid.origin[1] - (y + (corner >> 1)) * grid.pitch_m)
    cut = grid.cuts[x, y] * (np.array([1.0, 1.0, 2.0]) * grid.pitch_m / 255.0)
    inside &= ~((from_x < cut[:, 0]) | (from_y < cut[:, 1]) | (from_x + from_y < cut[:, 2]))
    return inside


def test_coverage_queries_equal_the_slow_twin():
    (plane,) = fit(shape(SHAPES['triangle'][0]), ModelsConfig(voxel_size_m=A), (0, 0, 5)).planes
    grid, end = plane.grid, np.array(plane.grid.filled.shape) * plane.grid.pitch_m
    places = np.random.default_rng(2).uniform(-0.1, 1.1, (3000, 2)) * end
    places = grid.origin + np.concatenate([places, end * [[1, 1], [1, 0.5], [0, 0]]])
    assert np.array_equal(grid.contains(places), slow_contains(grid, places))
    parts = grid.mask(3)
    middles = grid.origin + (np.argwhere(np.ones_like(parts)) + 0.5) * (grid.pitch_m / 3)
    assert np.array_equal(parts.reshape(-1), slow_contains(grid, middles))


def test_a_corner_that_cells_surround_is_not_cut():
    """Three by three cells, the middle one filled at its high x only, beside an empty one."""
    around = [(x, y) for x in range(3) for y in range(3) if (x, y) not in ((1, 1), (2, 1))]
    middles = [(x + 0.5, y + 0.5) for x, y in around]
    local = np.array([(x, y, 0.0) for x, y in [*middles, (1.9, 1.4), (2.99, 2.99), (0.0, 0.0)]])
    cells = Cells.around(local, np.zeros(len(local), int), np.ones(1), 0.1, snapped=True)
    assert cells.sizes.tolist() == [[3, 3]]
    middle = 4
    assert cells.grids()[0].rim.tolist() == [
        [True, True, True],
        [True, True, True],
        [True, False, True],
    ]
    assert cells.corner[middle] == 2  # low x, high y: all around it is filled
    assert not cells.cuts[middle].any()
    assert cells.cuts[8].any()  # its corner is that of the grid
