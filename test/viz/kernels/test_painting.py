# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Drawn discs equal those of a twin that intersects the ray of every pixel with every disc."""

import math

import numpy as np
import pytest

from surfel_mapper.viz.kernels.painting import blend_colours, draw_depth, shade_hollows
from test.kernels.modes import both

SIZE = (24, 31)


def some_discs(num=60, seed=3):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(num, 3))
    normal[:, 2] = np.abs(normal[:, 2]) + 0.3
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    centre = np.column_stack([rng.uniform(-10, 40, (num, 2)), rng.uniform(5, 8, num)])
    centre[:3, :2] = [[4, 5], [30, 23], [0, 0]]  # centres of pixels
    return np.column_stack(
        [centre, rng.uniform(0.2, 2.0, num), np.full(num, 5.0) + np.arange(num) % 3, normal]
    )


def hits(disc):
    """Return the depth of a disc at all pixels and the share of the radius left, by geometry."""
    u, v, depth, radius, scale, *normal = disc
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    rays = np.stack([(columns - u) / scale, (v - rows) / scale, np.zeros(SIZE)], axis=-1)
    towards = -(rays @ normal) / normal[2]  # onto the plane through the centre
    points = rays + towards[..., None] * [0.0, 0.0, 1.0]
    return depth - towards, 1.0 - (np.linalg.norm(points, axis=-1) / radius) ** 2


def empty():
    return np.full(SIZE, np.inf, np.float32)


@both
def test_the_nearest_disc_decides_the_depth_of_a_pixel(call):
    discs, depth, expected = some_discs(), empty(), np.full(SIZE, np.inf)

    call(draw_depth, discs, depth)

    for disc in discs:
        at, share = hits(disc)
        expected = np.where(share >= 0.0, np.minimum(expected, at), expected)
    np.testing.assert_allclose(depth, expected, atol=1e-5)
    assert 0.2 < np.isfinite(depth).mean() < 1.0


@both
def test_colours_near_the_front_are_averaged_by_the_distance_from_the_rim(call):
    discs, depth = some_discs(), empty()
    colours = np.random.default_rng(1).uniform(0.0, 255.0, (len(discs), 3)).astype(np.float32)
    image, weight = np.zeros((*SIZE, 3), np.float32), np.zeros(SIZE, np.float32)
    call(draw_depth, discs, depth)

    call(blend_colours, discs, colours, depth, image, weight)

    total, shares = np.zeros((*SIZE, 3)), np.zeros(SIZE)
    for disc, colour in zip(discs, colours, strict=True):
        at, share = hits(disc)
        share = np.where((share >= 0.0) & (at <= depth + 0.5 * disc[3]), share + 1e-3, 0.0)
        total, shares = total + share[..., None] * colour, shares + share
    np.testing.assert_allclose(weight, shares, atol=1e-4)
    np.testing.assert_allclose(image, total, atol=0.05)
    assert ((weight > 0.0) == np.isfinite(depth)).all()


@both
@pytest.mark.parametrize('slope', [0.0, 0.3, 2.0])
def test_a_plane_is_not_shaded_whatever_its_slope(call, slope):
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    depth = (5.0 + 0.1 * slope * (rows + columns)).astype(np.float32)
    image = np.full((*SIZE, 3), 200.0, np.float32)

    call(shade_hollows, depth, 0.1, False, 1.5, image)

    np.testing.assert_allclose(image, 200.0)


@both
def test_a_valley_is_darker_than_its_sides_and_a_ridge_is_not(call):
    across = np.abs(np.arange(SIZE[1]) - 15) * 0.1
    for sign, is_dark in ((-1.0, True), (1.0, False)):
        depth = np.tile(5.0 + sign * across, (SIZE[0], 1)).astype(np.float32)
        image = np.full((*SIZE, 3), 200.0, np.float32)
        call(shade_hollows, depth, 0.1, False, 1.5, image)
        # two units for pairs across the valley, of which each step has three of four
        dark = 200.0 * math.exp(-1.5 * 9 * (2.0 - 0.25) / 12.0)
        expected = max(dark, 0.4 * 200.0) if is_dark else 200.0
        np.testing.assert_allclose(image[12, 15], expected, rtol=1e-4)


@both
def test_shades_are_those_of_the_angle_at_any_distance_from_an_eye(call):
    near = 1.0 - 0.05 * np.abs(np.arange(SIZE[1]) - 15)
    images = np.full((2, *SIZE, 3), 200.0, np.float32)
    for image, factor in zip(images, (1.0, 3.0), strict=True):
        depth = np.tile(factor * near, (SIZE[0], 1)).astype(np.float32)
        call(shade_hollows, depth, 0.05, True, 1.5, image)

    np.testing.assert_allclose(images[1], images[0], rtol=1e-5)
    assert images[0].min() < 150.0


@both
def test_empty_images_stay_empty(call):
    depth, image = empty(), np.full((*SIZE, 3), 7.0, np.float32)
    call(draw_depth, np.empty((0, 8)), depth)
    call(shade_hollows, depth, 0.1, False, 1.5, image)
    assert np.isinf(depth).all()
    assert (image == 7.0).all()
