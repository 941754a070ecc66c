# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Drawn discs equal those of a twin that intersects the ray of every pixel with every disc."""

import numpy as np

from surfel_mapper.viz.kernels.painting import COLUMNS, paint
from test.kernels.modes import both

SIZE = (24, 31)


def some_discs(num=60, seed=3):
    """Return centre (px), depth, radius, px per m, normal and half size of the cell of discs."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(num, 3))
    normal[:, 2] = np.abs(normal[:, 2]) + 0.3
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    centre = np.column_stack([rng.uniform(-10, 40, (num, 2)), rng.uniform(5, 8, num)])
    centre[:3, :2] = [[4, 5], [30, 23], [0, 0]]  # centres of pixels
    scale, half_m = np.full(num, 5.0) + np.arange(num) % 3, rng.uniform(0.1, 2.0, (num, 3))
    return np.column_stack([centre, rng.uniform(0.2, 2.0, num), scale, normal, half_m])


def forms(discs):
    """Return the discs in the form of the kernel, whose boxes are the whole image."""
    u, v, depth, radius, scale, right, up, near = discs[:, :8].T
    zero = np.zeros(len(discs))
    box = [zero, zero + SIZE[0], zero, zero + SIZE[1]]
    behind = [depth, right / near / scale, -up / near / scale, 0.5 * radius]
    across = np.stack([zero + 1.0, zero, -right / near, zero, zero - 1.0, up / near]) / scale
    half = discs[:, 8:].T
    columns = [u, v, *box, *behind, *(np.concatenate([across, -half, half]) / radius)]
    return np.stack(columns, axis=1).astype(np.float32)


def hits(disc):
    """Return the depth of a disc at all pixels and its share, negative outside, by geometry."""
    u, v, depth, radius, scale = disc[:5]
    normal, half_m = disc[5:8], disc[8:]
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    rays = np.stack([(columns - u) / scale, (v - rows) / scale, np.zeros(SIZE)], axis=-1)
    towards = -(rays @ normal) / normal[2]  # onto the plane through the centre
    points = rays + towards[..., None] * [0.0, 0.0, 1.0]
    share = 1.0 - (np.linalg.norm(points, axis=-1) / radius) ** 2
    return depth - towards, np.where((np.abs(points) <= half_m).all(axis=-1), share, -1.0)


def painted(call, discs, colours):
    depth, image = np.full(SIZE, np.inf, np.float32), np.zeros((*SIZE, 4), np.float32)
    opaque = np.column_stack([colours, np.ones(len(colours))]).astype(np.float32)
    call(paint, forms(discs), opaque, depth, image)
    return depth, image


@both
def test_the_nearest_disc_decides_the_depth_of_a_pixel(call):
    discs, expected = some_discs(), np.full(SIZE, np.inf)

    depth, _ = painted(call, discs, np.zeros((len(discs), 3)))

    for disc in discs:
        at, share = hits(disc)
        expected = np.where(share >= 0.0, np.minimum(expected, at), expected)
    np.testing.assert_allclose(depth, expected, atol=1e-5)
    assert 0.2 < np.isfinite(depth).mean() < 1.0


@both
def test_colours_near_the_front_are_averaged_by_the_distance_from_the_rim(call):
    discs = some_discs()
    colours = np.random.default_rng(1).uniform(0.0, 255.0, (len(discs), 3))

    depth, image = painted(call, discs, colours)

    total, shares = np.zeros((*SIZE, 3)), np.zeros(SIZE)
    for disc, colour in zip(discs, colours, strict=True):
        at, share = hits(disc)
        share = np.where((share >= 0.0) & (at <= depth + 0.5 * disc[3]), share + 1e-3, 0.0)
        total, shares = total + share[..., None] * colour, shares + share
    np.testing.assert_allclose(image[..., 3], shares, atol=1e-4)
    np.testing.assert_allclose(image[..., :3], total, atol=0.05)
    assert ((image[..., 3] > 0.0) == np.isfinite(depth)).all()


@both
def test_no_discs_leave_an_image_as_it_is(call):
    depth, image = painted(call, np.empty((0, 11)), np.empty((0, 3)))
    assert np.isinf(depth).all()
    assert not image.any()
    assert forms(some_discs()).shape[1] == COLUMNS
