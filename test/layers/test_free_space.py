# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Verdicts on places from a range image, against a twin that knows the pixel of each place."""

import numpy as np
import pytest

from surfel_mapper.layers.dynamic_objects.kernels.free_space import (
    LEAST_PIXELS,
    look_through,
    SEEN,
    THROUGH,
    UNKNOWN,
)
from surfel_mapper.tsdf.sensors import LidarModel
from test.kernels.modes import both

MARGIN_M = 0.4
AROUND = LidarModel(rows=8, columns=40, vertical_fov_deg=40.0)
NARROW = LidarModel(rows=6, columns=20, vertical_fov_deg=20.0)
UNEVEN = LidarModel(rows=5, columns=24, beam_elevations_deg=(15.0, 6.0, 2.0, -1.0, -14.0))


def verdicts_of(call, sensor, image, places):
    x, y, z = np.asarray(places, np.float32).T.copy()
    verdict = np.full(len(x), 99, np.int8)
    call(
        look_through,
        *(x, y, z, sensor.projection, image, sensor.columns, np.float32(MARGIN_M), verdict),
    )
    return verdict


def image_of(sensor, ranges, around):
    """Return an image for the kernel; one all around repeats its first column."""
    return np.concatenate([ranges, ranges[:, :1]], axis=1) if around else ranges.copy()


def twin(ranges, row, column, distance, around):
    """Return the verdict on a place at a distance along the ray of a pixel."""
    window = []
    for r in range(max(row - 1, 0), min(row + 2, ranges.shape[0])):
        for c in (column - 1, column, column + 1):
            if around or 0 <= c < ranges.shape[1]:
                window.append(float(ranges[r, c % ranges.shape[1]]))
    known = [value for value in window if value > 0.0]
    if len(known) >= LEAST_PIXELS and min(known) > distance + MARGIN_M:
        return THROUGH
    here = float(ranges[row, column])
    return SEEN if here > 0.0 and abs(here - distance) <= MARGIN_M else UNKNOWN


@both
@pytest.mark.parametrize(('sensor', 'around'), [(AROUND, True), (UNEVEN, True)], ids=str)
def test_verdicts_equal_those_of_the_twin(call, sensor, around):
    rng = np.random.default_rng(3)
    shape = sensor.rows, sensor.columns
    ranges = rng.uniform(3.0, 9.0, shape).astype(np.float32)
    ranges[:, : shape[1] // 2] = 6.0  # walls, so that all three verdicts occur
    ranges[rng.random(shape) < 0.3] = 0.0
    row, column = rng.integers(0, shape, (600, 2)).T
    distance = rng.uniform(1.0, 10.0, 600)
    places = sensor.directions[row, column] * distance[:, None]

    found = verdicts_of(call, sensor, image_of(sensor, ranges, around), places)

    expected = [twin(ranges, *place, around) for place in zip(row, column, distance, strict=True)]
    assert found.tolist() == expected
    assert {SEEN, UNKNOWN, THROUGH} == set(expected)


@both
def test_places_outside_the_view_are_unknown(call):
    ranges = np.full((NARROW.rows, NARROW.columns), 9.0, np.float32)
    places = [[0.0, 0.0, 3.0], [1.0, 0.0, 2.0], [np.nan] * 3, [np.inf, 0.0, 0.0]]
    assert (verdicts_of(call, NARROW, ranges, places) == UNKNOWN).all()
    assert verdicts_of(call, NARROW, ranges, [[3.0, 0.0, 0.0]]).tolist() == [THROUGH]


@both
def test_four_known_pixels_of_nine_are_not_enough(call):
    ranges = np.zeros((AROUND.rows, AROUND.columns), np.float32)
    ranges[3, 9:12] = ranges[4, 9] = 8.0
    place = [3.0 * AROUND.directions[4, 10]]
    assert verdicts_of(call, AROUND, image_of(AROUND, ranges, True), place) == UNKNOWN
    ranges[4, 11] = 8.0
    assert verdicts_of(call, AROUND, image_of(AROUND, ranges, True), place) == THROUGH
