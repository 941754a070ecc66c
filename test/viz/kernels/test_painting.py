# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Painted ellipses equal those of a twin that computes the coverage of every pixel."""

import math

import numpy as np

from surfel_mapper.viz.kernels.painting import paint_discs
from test.kernels.modes import both

SIZE = (24, 31)


def twin(discs, colours, image):
    """Paint by the formula of the kernel, all pixels at a time."""
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float64)
    for (u, v, length, breadth, angle), colour in zip(discs, colours, strict=True):
        offset = np.stack([columns - u, rows - v])
        turned = np.array(
            [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
        )
        along, across = np.einsum('ij,jrc->irc', turned, offset)
        with np.errstate(divide='ignore', invalid='ignore'):
            to_rim = np.hypot(*offset) * (1.0 / np.hypot(along / length, across / breadth) - 1.0)
        cover = np.clip(np.nan_to_num(to_rim, nan=np.inf) + 0.5, 0.0, 1.0)[..., None]
        image[:] = (image + cover * (colour - image)).astype(np.float32)


def white():
    return np.full((*SIZE, 3), 255.0, np.float32)


@both
def test_ellipses_of_any_kind_and_place_are_painted_as_by_the_twin(call):
    rng = np.random.default_rng(3)
    discs = np.column_stack(
        [rng.uniform(-10, 40, (60, 2)), rng.uniform(0.5, 9.0, (60, 2)), rng.uniform(-4, 4, 60)]
    )
    discs[:3, :2] = [[4, 5], [30, 23], [0, 0]]  # centres of pixels
    colours = rng.uniform(0.0, 255.0, (60, 3)).astype(np.float32)
    image, expected = white(), white()

    call(paint_discs, discs, colours, image)

    twin(discs, colours, expected)
    np.testing.assert_allclose(image, expected, atol=0.01)


@both
def test_the_length_runs_at_its_angle_and_the_last_is_on_top(call):
    image = white()
    discs = np.array([[10.0, 10.0, 9.0, 1.0, math.pi / 4], [10.0, 10.0, 1.0, 1.0, 0.0]])
    call(paint_discs, discs, np.array([[0, 0, 0], [200, 0, 0]], np.float32), image)
    assert image[15, 15, 0] == 0.0  # down to the right
    assert image[5, 15, 0] == 255.0
    np.testing.assert_array_equal(image[10, 10], [200.0, 0.0, 0.0])
