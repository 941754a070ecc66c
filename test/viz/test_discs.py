# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Discs have the place, normal and size of their surfels, and the colours of their values."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper import SurfelMap
from surfel_mapper.errors import ConfigError
from surfel_mapper.viz.discs import (
    BEYOND_CELL,
    Colouring,
    COLOURINGS,
    COLUMNS,
    CORNERS,
    DrawnDiscs,
)

VIRIDIS_ENDS = [[68, 1, 84], [253, 231, 37]]
"""First and last colour of the map, as matplotlib documents them (#440154, #fde725)."""


def discs(**values):
    position = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 9.0], [0.0, 0.0, 3.5]])
    normal = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
    return DrawnDiscs(position, normal, np.array([0.5, 1.0, 2.0]), values)


def test_corners_lie_on_a_circle_about_the_disc_across_the_normal():
    shown = discs()
    corners, triangles = shown.triangles()
    away = corners.reshape(3, CORNERS, 3) - shown.position[:, None]

    np.testing.assert_allclose(
        np.linalg.norm(away, axis=2),
        np.tile([[0.5], [1.0], [2.0]], CORNERS) / np.cos(np.pi / 8.0),
        atol=1e-6,
    )
    np.testing.assert_allclose(np.einsum('kci,ki->kc', away, shown.normal), 0.0, atol=1e-6)
    a, b, c = (corners[triangles[:, n]] for n in range(3))
    across = np.cross(b - a, c - a).reshape(3, CORNERS - 2, 3)
    area = 0.5 * np.einsum('kti,ki->k', across, shown.normal)
    # an octagon about a circle of radius r, turning to the left as seen from its normal
    expected = 8.0 * (np.sqrt(2.0) - 1.0) * shown.radius_m**2
    np.testing.assert_allclose(area[:2], expected[:2], rtol=1e-5)
    assert np.pi * shown.radius_m[2] ** 2 < area[2] < expected[2]  # a tilted one is less regular


@pytest.mark.parametrize('grid_m', [0.0, 0.3])
def test_corners_end_one_voxel_beyond_the_cell(grid_m):
    size = np.array([4.0, 4.0, 0.5])
    shown = discs(size=size)
    shown = DrawnDiscs(
        shown.position, shown.normal, 5.0 * np.ones(3), shown.values, np.full(3, grid_m)
    )

    corners = shown.triangles()[0].reshape(3, CORNERS, 3)

    low = np.floor((shown.position - grid_m) / size[:, None]) * size[:, None] + grid_m
    beyond_m = 0.5 * BEYOND_CELL
    least, most = low - beyond_m, low + size[:, None] + beyond_m
    assert (corners >= least[:, None] - 1e-5).all()
    assert (corners <= most[:, None] + 1e-5).all()
    for disc, axes in enumerate(([0, 1], [1, 2])):  # those along the axes reach the cell
        np.testing.assert_allclose(corners[disc].min(axis=0)[axes], least[disc, axes], atol=1e-5)
        np.testing.assert_allclose(corners[disc].max(axis=0)[axes], most[disc, axes], atol=1e-5)
    away = corners - shown.position[:, None]
    np.testing.assert_allclose(np.einsum('kci,ki->kc', away, shown.normal), 0.0, atol=1e-5)


def test_surfels_without_a_normal_have_no_disc():
    surfel_map = SurfelMap(0.5)
    rng = np.random.default_rng(0)
    surfel_map.add(np.concatenate([[[9.1, 9.1, 9.1]], rng.uniform(0.0, 0.4, (20, 3))]))
    found = DrawnDiscs.of(surfel_map.surfels())

    assert len(found) == 1
    assert set(found.values) == set(COLUMNS)
    assert found.values['num_points'].tolist() == [20]


def test_a_full_square_is_covered_by_a_disc_of_its_size():
    surfel_map = SurfelMap(1.0)
    side = np.linspace(0.005, 0.995, 100)
    surfel_map.add(
        np.stack([*map(np.ravel, np.meshgrid(side, side)), np.full(10_000, 0.5)], axis=1)
    )
    found = DrawnDiscs.of(surfel_map.surfels())
    # between the circle within the square and the one around it
    assert 0.5 < found.radius_m[0] < np.sqrt(0.5) + 0.03


def test_heights_run_through_the_colour_map():
    shown = discs()
    colours = Colouring('height', 3.0, 9.0).of(shown)
    np.testing.assert_array_equal(colours[:2], VIRIDIS_ENDS)


def test_ends_of_a_colour_map_leave_out_outliers():
    values = np.append(np.linspace(2.0, 4.0, 999), 1e6)
    found = Colouring.over('intensity', [many(intensity=values)])
    assert 2.0 <= found.low < 2.1
    assert 3.9 < found.high < 4.1


def many(**values):
    number = len(next(iter(values.values())))
    return DrawnDiscs(
        np.zeros((number, 3)), np.tile([0.0, 0.0, 1.0], (number, 1)), np.ones(number), values
    )


def test_unknown_values_are_grey():
    shown = discs(age=np.array([0.0, np.nan, 1.0]))
    colours = Colouring.over('age', [shown]).of(shown)
    assert np.ptp(colours[1].astype(int)) == 0
    np.testing.assert_array_equal(colours[[0, 2]], VIRIDIS_ENDS)


def test_colours_are_taken_as_they_are():
    shown = discs(
        red=np.array([10, 20, 30]),
        green=np.array([0.0, 127.5, 255.0]),
        blue=np.zeros(3),
    )
    np.testing.assert_array_equal(
        Colouring.over('rgb', [shown]).of(shown), [[10, 0, 0], [20, 128, 0], [30, 255, 0]]
    )


@pytest.mark.parametrize(
    'kind', [kind for kind in COLOURINGS if kind not in ('normal', 'height', 'planarity')]
)
def test_values_that_nothing_has_are_refused(kind):
    with pytest.raises(ConfigError, match=rf"colouring '{kind}': nothing shown has it.*: quality"):
        Colouring.over(kind, [discs(quality=np.zeros(3))])
