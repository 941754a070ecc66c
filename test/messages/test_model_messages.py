# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Markers and columns of models agree with the models."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfel_mapper.config import ModelsConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.messages.markers import (
    ADD,
    DELETE_ALL,
    LINE_LIST,
    marker_array,
    TEXT_VIEW_FACING,
    TRIANGLE_LIST,
)
from surfel_mapper.messages.model_messages import (
    GAUSSIAN,
    GREY,
    MAX_GAUSSIANS,
    model_markers,
    most_points,
    NONE,
    PLANE,
    primitive_columns,
    SURFACE,
    surfel_primitive_columns,
)
from surfel_mapper.messages.pointcloud2 import from_columns
from surfel_mapper.models import fit
from surfel_mapper.models.fitting import surfel_points
from surfel_mapper.models.multi_model import Gaussians
from surfel_mapper.models.outlines import areas
from surfel_mapper.models.shapes import Shapes
from test.models.scenes import A, room, VIEW


@pytest.fixture(scope='module')
def seen():
    points, _ = room(160, 120)
    model = fit(points, ModelsConfig(voxel_size_m=A), VIEW)
    ids = [*(patch.id for patch in model.patches), *model.gaussians.id.tolist()]
    versions = {number: 3 * number + 1 for number in ids}
    return model, versions, Shapes().of(model, versions)


@pytest.fixture(scope='module')
def markers(seen):
    model, _, shapes = seen
    return model_markers(shapes, model.gaussians, A, stamp_ns=5, frame_id='map')


def by_name(markers):
    return {(marker.ns, marker.id): marker for marker in markers}


def no_gaussians():
    return Gaussians(np.empty(0, int), np.empty(0, int), np.empty((0, 3)), np.empty((0, 3, 3)))


def test_markers_begin_by_deleting_all_and_then_add(markers):
    assert [marker.action for marker in markers] == [DELETE_ALL] + [ADD] * (len(markers) - 1)
    assert {(marker.frame_id, marker.stamp_ns) for marker in markers} == {('map', 5)}


def test_every_patch_is_filled_and_has_outline_and_id(seen, markers):
    model, _, shapes = seen
    found = by_name(markers)
    names = {('', 0), ('gaussians', 0)}
    for shape in shapes:
        number = shape.patch.id
        kind = 'planes' if number < len(model.planes) else 'surfaces'
        fill, lines, text = (found[ns, number] for ns in (kind, 'outlines', 'ids'))
        names |= {(ns, number) for ns in (kind, 'outlines', 'ids')}
        assert (fill.type, lines.type, text.type) == (
            TRIANGLE_LIST,
            LINE_LIST,
            TEXT_VIEW_FACING,
        )
        triangles = fill.points.reshape(-1, 3, 3)
        assert areas(triangles).sum() == pytest.approx(shape.area_m2)
        assert text.text == str(number)
        ends = lines.points.reshape(-1, 2, 3)
        assert len(ends) == sum(len(ring) for ring in shape.rings)
        # every corner of a ring is the end of one side and the start of the next
        starts = {tuple(corner) for corner in ends[:, 0].tolist()}
        assert starts == {tuple(corner) for corner in ends[:, 1].tolist()}
        assert starts == {tuple(corner) for ring in shape.rings for corner in ring.tolist()}
    assert set(found) == names


def test_surfaces_and_gaussians_are_shaded(seen, markers):
    model, found = seen[0], by_name(markers)
    bent = found['surfaces', model.surfaces[0].id]
    assert bent.colors.shape == (len(bent.points), 4)
    assert len(np.unique(bent.colors[:, 0])) > 3
    cloud = found['gaussians', 0]
    assert len(cloud.points) == 60 * len(model.gaussians)
    assert (cloud.colors[:, :3] <= np.float32(GREY)).all()
    assert (cloud.colors[:, 3] == 1.0).all()


def test_no_models_give_one_marker_that_deletes_all():
    (only,) = model_markers([], no_gaussians(), A, stamp_ns=5, frame_id='map')
    assert only.action == DELETE_ALL
    assert len(marker_array([only])) < 400


def test_the_gaussians_with_most_points_are_drawn_if_there_are_too_many():
    number = MAX_GAUSSIANS + 9
    many = Gaussians(
        id=np.arange(number),
        num_points=np.arange(number)[::-1] + 1,
        mean=np.zeros((number, 3)),
        covariance=np.tile(np.eye(3), (number, 1, 1)),
    )
    assert most_points(many, MAX_GAUSSIANS).id.tolist() == list(range(MAX_GAUSSIANS))
    drawn = model_markers([], many, A, stamp_ns=5, frame_id='map')[-1]
    assert len(drawn.points) == 60 * MAX_GAUSSIANS


def test_each_row_describes_its_primitive(seen):
    model, versions, shapes = seen
    columns = primitive_columns(shapes, model.gaussians, versions)
    num_patches = len(model.patches)
    assert columns['id'].tolist() == list(versions)
    assert columns['version'].tolist() == list(versions.values())
    assert columns['kind'].tolist() == (
        [PLANE] * len(model.planes)
        + [SURFACE] * len(model.surfaces)
        + [GAUSSIAN] * len(model.gaussians)
    )
    assert int(columns['num_points'].sum()) == model.num_thinned
    normal = np.stack([columns[f'normal_{axis}'] for axis in 'xyz'], axis=1)
    place = np.stack([columns[axis] for axis in 'xyz'], axis=1)
    for row, plane in enumerate(model.planes):
        assert normal[row] == pytest.approx(plane.normal, abs=1e-6)
        assert columns['d'][row] == pytest.approx(plane.offset_m, abs=1e-5)
        assert normal[row] @ place[row] + columns['d'][row] == pytest.approx(0.0, abs=1e-5)
        assert columns['rms'][row] == pytest.approx(plane.rms_m, rel=1e-5)
        assert columns['area'][row] == pytest.approx(shapes[row].area_m2, rel=1e-5)
    assert place[num_patches:] == pytest.approx(model.gaussians.mean, abs=1e-5)
    for name in ('normal_x', 'd', 'area', 'rms'):
        assert np.isnan(columns[name][num_patches:]).all()


def test_points_of_a_primitive_are_in_its_box(seen):
    model, versions, shapes = seen
    columns = primitive_columns(shapes, model.gaussians, versions)
    points = room(160, 120)[0].astype(np.float64)
    for row in range(len(model.patches)):
        turn = Rotation.from_quat([columns[f'q{axis}'][row] for axis in 'xyzw'])
        middle = np.array([columns[axis][row] for axis in 'xyz'])
        half = 0.5 * np.array([columns[f'extent_{axis}'][row] for axis in 'xyz'])
        local = np.abs(turn.inv().apply(points[model.labels == row] - middle))
        assert (local[:, :2] < half[:2] + A).all()
        assert np.mean(local[:, 2] < half[2] + 2 * A) > 0.95


def test_the_box_of_a_gaussian_has_the_axes_of_its_covariance(seen):
    model, versions, shapes = seen
    columns = primitive_columns(shapes, model.gaussians, versions)
    for row, covariance in enumerate(model.gaussians.covariance, len(model.patches)):
        R = Rotation.from_quat([columns[f'q{axis}'][row] for axis in 'xyzw']).as_matrix()
        sigma = np.array([columns[f'extent_{axis}'][row] for axis in 'xyz']) / 4.0
        assert R @ np.diag(sigma**2) @ R.T == pytest.approx(covariance, abs=1e-6)


def test_no_primitives_give_a_cloud_without_rows():
    content = from_columns(primitive_columns([], no_gaussians(), {}))
    assert content.width == 0
    assert len(content.fields) == 20


def test_each_surfel_has_the_id_and_the_kind_of_its_primitive():
    surfel_map = SurfelMap(voxel_size_m=0.1)
    surfel_map.add(room(160, 120)[0], origin=VIEW)
    surfels = surfel_map.surfels(5)
    # the second of nine points of a surfel for its label
    model = fit(surfel_points(surfels, 0.1), ModelsConfig(voxel_size_m=0.05), VIEW)
    labels = model.labels[1::9].copy()
    labels[::7] = -1
    labelled = type(model)(
        model.planes, model.surfaces, model.gaussians, labels, 0.05, model.num_thinned
    )
    columns = surfel_primitive_columns(surfels, labelled)
    assert np.array_equal(columns['primitive'], labels)
    assert columns['primitive'].dtype == np.int32
    assert np.array_equal(columns['x'], surfels.position[:, 0].astype(np.float32))
    assert np.array_equal(columns['normal_z'], surfels.normal[:, 2].astype(np.float32))
    first_surface = len(model.planes)
    first_gaussian = first_surface + len(model.surfaces)
    expected = np.where(labels < first_surface, PLANE, SURFACE)
    expected[labels >= first_gaussian] = GAUSSIAN
    expected[labels == -1] = NONE
    assert np.array_equal(columns['kind'], expected)
    assert {PLANE, GAUSSIAN, NONE} <= set(columns['kind'].tolist())
