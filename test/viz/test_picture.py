# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The picture of a map shows what faces the viewer, to scale, shaded or by planarity."""

import dataclasses

import numpy as np
from PIL import Image
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.mapping.surfels import concatenated, Surfels
from surfel_mapper.viz.picture import draw_map, Frame, limits, views, X, Y, Z

YELLOW, PURPLE = np.array([[0.993, 0.906, 0.144], [0.267, 0.005, 0.329]])
"""Both ends of viridis, the colours of planarity 1 and 0."""


def sheet(height_m, up, planarity, size_m=(20.0, 10.0), centre=(0.0, 0.0)):
    """Return a horizontal sheet of full 0.5 m voxels, its normals up (1) or down (-1)."""
    steps = [np.arange(-half + 0.25, half, 0.5) for half in np.array(size_m) / 2.0]
    x, y = (axis.ravel() for axis in np.meshgrid(*steps))
    position = np.column_stack([x + centre[0], y + centre[1], np.full(x.size, height_m)])
    num = len(position)
    return Surfels(
        position=position,
        normal=np.tile([0.0, 0.0, up], (num, 1)),
        planarity=np.full(num, planarity),
        curvature=np.zeros(num),
        eigenvalues=np.tile([0.0, 0.25 / 12.0, 0.25 / 12.0], (num, 1)),
        num_points=np.full(num, 9),
        voxel_index=np.floor(position / 0.5).astype(np.int32),
        thickness=np.zeros(num),
        normal_sigma=np.full(num, 0.01),
        radius=np.full(num, 0.25 / 3.0**0.5),
        num_scans=np.ones(num, np.int64),
        size=np.full(num, 0.5),
    )


def drawn(tmp_path, surfels, **options):
    draw_map(surfels, tmp_path / 'map.png', **{'colouring': 'planarity', **options})
    return np.asarray(Image.open(tmp_path / 'map.png').convert('RGB')) / 255.0


def num_pixels(image, colour):
    return int((np.abs(image - colour).max(axis=2) < 0.02).sum())


def test_a_ceiling_does_not_hide_the_floor(tmp_path):
    image = drawn(tmp_path, concatenated([sheet(0.0, 1.0, 1.0), sheet(5.0, -1.0, 0.0)]))

    assert num_pixels(image, YELLOW) > 10 * num_pixels(image, PURPLE)


def test_planes_are_of_one_colour_whatever_their_planarity(tmp_path):
    sheets = sheet(0.0, 1.0, 1.0)
    stripes = np.arange(len(sheets)) % 2.0
    striped = dataclasses.replace(sheets, planarity=stripes)

    image = drawn(tmp_path, striped, colouring='normal')
    assert np.array_equal(image, drawn(tmp_path, sheets, colouring='normal'))
    # white by 0.88, 45 % of the colour of the normal (0.5, 0.5, 1); light at 0.73 from above
    expected = (0.55 * 0.88 + 0.45 * np.array([0.5, 0.5, 1.0])) * (0.3 + 0.7 * (0.5 + 0.5 * 0.73))
    assert num_pixels(image, expected) > 100_000
    assert num_pixels(drawn(tmp_path, striped), expected) == 0


def test_a_roof_hides_the_ground(tmp_path):
    image = drawn(tmp_path, concatenated([sheet(0.0, 1.0, 1.0), sheet(5.0, 1.0, 0.0)]))

    assert num_pixels(image, PURPLE) > 10 * num_pixels(image, YELLOW)


def test_a_plane_has_no_gaps_and_its_true_proportions(tmp_path):
    image = drawn(tmp_path, sheet(0.0, 1.0, 1.0))
    yellow = np.abs(image - YELLOW).max(axis=2) < 0.02
    yellow[:, int(0.9 * image.shape[1]) :] = False  # the colour bar
    rows, columns = np.flatnonzero(yellow.sum(axis=1) > 100), np.flatnonzero(yellow.any(axis=0))
    top = yellow[rows[0] : rows[-1] + 1]
    top = top[: np.argmin(top.sum(axis=1) > 100)]  # without the sheet seen from the side

    assert top[:, columns[0] : columns[-1] + 1].mean() > 0.95
    assert np.ptp(columns) / len(top) == pytest.approx(2.0, rel=0.05)


def test_a_few_far_surfels_do_not_shrink_the_rest(tmp_path):
    near = sheet(0.0, 1.0, 1.0)
    far = sheet(0.0, 1.0, 1.0, size_m=(0.5, 0.5), centre=(5000.0, 300.0))

    alone, both = (limits(part) for part in (near, concatenated([near, far])))

    np.testing.assert_allclose(both, alone, atol=0.5)


def test_the_longer_way_lies_across_and_both_views_stand_the_right_way_round():
    for extent, across in (([50.0, 20.0, 9.0], X), ([20.0, 50.0, 9.0], Y)):
        above, side = views(np.array(extent))
        assert above.right == side.right == across
        assert (above.near, side.up) == (Z, Z)
        for view in (above, side):
            axes = np.zeros((3, 3))
            for row, (axis, sign) in enumerate(
                zip((view.right, view.up, view.near), view.signs, strict=True)
            ):
                axes[row, axis] = sign
            assert np.linalg.det(axes) == 1.0  # no mirror image


def test_pixels_lie_where_the_axes_say_whichever_way_they_run():
    low, high = np.array([-3.0, 10.0, 0.0]), np.array([5.0, 50.0, 2.0])
    above, side = (Frame.of(view, (low, high), 10.0) for view in views(high - low))

    assert (above.width, above.height) == (400, 80)
    assert above.bounds == ((10.0, 50.0), (5.0, -3.0))  # y to the right, x down
    assert side.bounds == ((10.0, 50.0), (0.0, 2.0))
    np.testing.assert_allclose(above.placed(low[None]), [[-0.5, -0.5]])
    np.testing.assert_allclose(above.placed(high[None]), [[399.5, 79.5]])
    np.testing.assert_allclose(side.placed(low[None]), [[-0.5, 19.5]])
    image = above.gridded()
    for value, column in ((20.0, 100), (40.0, 300)):
        assert value in above.ticks()[0]
        assert (image[:, column] < 255.0).all()


def test_the_trajectory_is_drawn(tmp_path):
    path = np.column_stack([np.linspace(-8.0, 8.0, 50), np.zeros(50), np.full(50, 1.0)])

    images = [drawn(tmp_path, sheet(0.0, 1.0, 1.0), trajectory=t) for t in (None, path)]

    without, with_path = (((i[..., 0] > 0.7) & (i[..., 1] < 0.4)).sum() for i in images)
    assert without == 0
    assert with_path > 500


def test_surfels_without_a_normal_are_left_out(tmp_path):
    odd = sheet(1.0, 1.0, np.nan)
    odd.normal[:] = np.nan

    image = drawn(tmp_path, concatenated([sheet(0.0, 1.0, 1.0), odd]))

    assert num_pixels(image, YELLOW) > 10_000


def test_a_map_without_surfels_gives_empty_axes(tmp_path):
    nothing = sheet(0.0, 1.0, 1.0).select(np.zeros(0, np.int64))

    assert drawn(tmp_path, nothing).min() < 0.5


def test_the_same_map_gives_the_same_file(tmp_path):
    draw_map(sheet(0.0, 1.0, 0.5), tmp_path / 'a.png', 'a')
    draw_map(sheet(0.0, 1.0, 0.5), tmp_path / 'b.png', 'a')

    assert (tmp_path / 'a.png').read_bytes() == (tmp_path / 'b.png').read_bytes()


def test_a_file_that_cannot_be_written_is_an_error(tmp_path):
    with pytest.raises(FileFormatError, match='nowhere'):
        draw_map(sheet(0.0, 1.0, 1.0), tmp_path / 'nowhere' / 'map.png')
