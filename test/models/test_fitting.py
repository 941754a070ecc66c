# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Models of whole clouds: objects found in a room, accuracy, invalid input."""

from __future__ import annotations

from functools import cache
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from surfel_mapper.config import ModelsConfig
from surfel_mapper.errors import ConfigError, ModelError
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models import evaluate, fit
from surfel_mapper.models.fitting import narrow_groups, surfel_points
from surfel_mapper.models.segmentation import folded, merge_clusters, segment_cloud
from surfel_mapper.models.thinning import thin
from test.bench import tabletop
from test.models.scenes import (
    A,
    AXIS,
    BALL,
    BALL_RADIUS,
    CENTRE,
    CYLINDER,
    CYLINDER_RADIUS,
    FLAT,
    room,
    sheet,
    VIEW,
)

TABLETOP = [(0.01, 0.98, 0.15), (0.02, 0.95, 0.25), (0.03, 0.90, 0.40)]
"""Voxel size, m; least share of the table in one plane; largest share of objects in no patch."""


@pytest.fixture(scope='module')
def seen():
    points, lies_on = room()
    return points, lies_on, fit(points, ModelsConfig(voxel_size_m=A), VIEW)


def owner(model, patch, lies_on):
    """Return the object that most points of a patch lie on, and their share."""
    counts = np.bincount(lies_on[model.labels == patch.id], minlength=8)
    return counts.argmax(), counts.max() / counts.sum()


def test_floor_walls_and_faces_are_one_plane_each(seen):
    _, lies_on, model = seen
    found = [owner(model, plane, lies_on) for plane in model.planes if plane.num_points >= 100]
    assert sorted(which for which, _ in found) == sorted(FLAT)
    assert min(share for _, share in found) > 0.95
    for which in FLAT:
        labels = model.labels[lies_on == which]
        assert np.bincount(labels).max() / len(labels) > 0.9


def test_models_do_not_depend_on_repeated_points():
    """Facets and joins counted points, which are as many as there are in a close surface."""
    points, _ = room(noise_per_range_sq=1e-3)
    config = ModelsConfig(voxel_size_m=A, noise_per_range_sq=1e-3)
    once, twice = (fit(np.tile(points.reshape(-1, 3), (n, 1)), config, VIEW) for n in (1, 2))
    assert len(once.planes) == len(twice.planes)
    assert twice.labels.tolist() == 2 * once.labels.tolist()


@pytest.mark.parametrize(('which', 'most'), [(CYLINDER, 2), (BALL, 4)])
def test_round_objects_are_few_surfaces_within_7_mm(seen, which, most):
    _, lies_on, model = seen
    own = [s for s in model.surfaces if owner(model, s, lies_on)[0] == which]
    assert 1 <= len(own) <= most
    assert max(surface.rms_m for surface in own) <= 0.007


@pytest.mark.parametrize('size_m', [0.01, 0.02, 0.03])
def test_a_camera_sees_a_round_object_as_one_surface(size_m):
    points, lies_on = room(noise_per_range_sq=1.425e-3)
    model = fit(points, ModelsConfig(voxel_size_m=size_m, noise_per_range_sq=1.425e-3), VIEW)
    for which in (CYLINDER, BALL):
        labels = model.labels[lies_on == which]
        largest = np.bincount(labels[labels < len(model.patches)]).argmax()
        assert largest >= len(model.planes)
        assert (labels == largest).mean() > 0.94
    xyz = model.surfaces[0].lifted(model.surfaces[0].grid.samples(size_m))
    cylinder = np.linalg.norm(xyz[:, :2] - AXIS, axis=1) - CYLINDER_RADIUS
    ball = np.linalg.norm(xyz - CENTRE, axis=1) - BALL_RADIUS
    assert min(np.sqrt(np.mean(away**2)) for away in (cylinder, ball)) < 0.003


def test_surfaces_lie_on_the_ball_and_their_normals_point_out(seen):
    _, lies_on, model = seen
    for surface in model.surfaces:
        if owner(model, surface, lies_on)[0] == BALL:
            xy = surface.grid.samples(A)
            out = surface.lifted(xy) - CENTRE
            radius = np.linalg.norm(out, axis=1)
            assert math.sqrt(np.mean((radius - BALL_RADIUS) ** 2)) < 0.007
            assert np.median((surface.normals(xy) * out).sum(axis=1) / radius) > 0.99


def test_every_chart_of_a_closed_cylinder_is_a_height_field():
    angle, z = np.meshgrid(np.linspace(0, 2 * np.pi, 400), np.arange(0, 1.5, A / 2))
    tube = np.stack([0.35 * np.cos(angle), 0.35 * np.sin(angle), z], -1).reshape(-1, 3)
    config = ModelsConfig(voxel_size_m=A)
    inside = np.array([0.0, 0.0, 0.75])  # sees all of it, its normals point inwards
    clusters = segment_cloud(thin(tube, A).means, config, inside)
    charts = merge_clusters(clusters, config, inside)
    assert len(charts) >= 2
    assert all(folded(clusters, chart, config) is None for chart in charts)
    model = fit(tube, config, inside)
    assert sum(surface.num_points for surface in model.surfaces) > 0.8 * model.num_thinned
    for surface in model.surfaces:
        place = surface.samples(A)
        radius = np.linalg.norm(place[:, :2], axis=1)
        assert math.sqrt(np.mean((radius - 0.35) ** 2)) < 0.007


def test_exact_plane_is_recovered():
    cloud = sheet(1.5, 1.0, A / 4, (1.0, 2.0, 3.0), (5.0, -2.0, 1.0))
    model = fit(cloud, ModelsConfig(voxel_size_m=A), (5.0, 5.0, 20.0))
    (plane,) = model.planes
    assert plane.normal == pytest.approx(np.array([1, 2, 3]) / math.sqrt(14), abs=1e-9)
    assert plane.normal @ cloud.T + plane.offset_m == pytest.approx(0.0, abs=1e-9)
    found = model.evaluate(cloud)
    assert found == evaluate(model, cloud)
    assert found.precision_rms_m < A / 2
    assert found.completeness_rms_m < A
    assert found.coverage == 1.0


def test_the_models_are_twice_as_precise_as_gaussians_alone(seen):
    points, _, model = seen
    alone = fit(points, ModelsConfig(voxel_size_m=A, kinds='gaussians'), VIEW)
    assert not alone.patches
    assert len(alone.gaussians) > len(model.gaussians)
    ours, theirs = evaluate(model, points), evaluate(alone, points)
    assert theirs.precision_rms_m / ours.precision_rms_m >= 2.0
    assert ours.completeness_rms_m < theirs.completeness_rms_m
    assert ours.compression > 100.0


@cache
def fitted_frame(file, size_m):
    """Return points, labels and models of a real frame, for two tests."""
    points, labels = tabletop.frame(file)
    return points, labels, fit(points, ModelsConfig(voxel_size_m=size_m))


@pytest.mark.parametrize('voxel_size_m', [0.01, 0.02])
def test_real_frames_are_twice_as_precise_as_gaussians(data_folder, voxel_size_m):
    found = []
    for file in sorted((data_folder / 'data' / 'osd').glob('*.pcd')):
        points, _, all_kinds = fitted_frame(file, voxel_size_m)
        gaussians = fit(points, ModelsConfig(voxel_size_m=voxel_size_m, kinds='gaussians'))
        for model in (all_kinds, gaussians):
            row = evaluate(model, points)
            found.append((row.precision_rms_m, row.completeness_rms_m))
    ours, theirs = np.mean(found[::2], axis=0), np.mean(found[1::2], axis=0)
    assert ours[0] < 0.5 * theirs[0]
    assert ours[1] < 0.85 * theirs[1]
    assert max(ours) < 0.03


@pytest.mark.parametrize(('size_m', 'table', 'free'), TABLETOP)
def test_table_is_one_plane_and_objects_are_patches(data_folder, size_m, table, free):
    found = []
    for file in sorted((data_folder / 'data' / 'osd').glob('*.pcd')):
        points, labels, model = fitted_frame(file, size_m)
        number = len(model.patches)
        patch = np.where(model.labels < number, model.labels, -1)
        planes = np.arange(number) < len(model.planes)
        found.append(tabletop.figures(points, labels, patch, planes))
    mean = {key: np.mean([one[key] for one in found]) for key in found[0]}
    assert mean['table'] >= table
    assert mean['free'] <= free
    assert mean['impure'] <= 0.01


TURNED = [('test0', 2, 0.03), ('test1', 4, 0.03), ('test10', 2, 0.025), ('test12', 18, 0.03)]
"""Frames, seeds of their directions, and voxel sizes, m, in which tables were two planes."""


@pytest.mark.parametrize(('name', 'seed', 'size_m'), TURNED)
def test_distorted_tables_are_one_plane_in_any_direction(data_folder, name, seed, size_m):
    """Halves that differ by less than the noise of the camera were two planes."""
    from scipy.spatial.transform import Rotation

    points, labels = tabletop.frame(data_folder / 'data' / 'osd' / f'{name}.pcd')
    R_turned_camera = Rotation.from_quat(np.random.default_rng(seed).standard_normal(4))
    points = points @ R_turned_camera.as_matrix().T.astype(np.float32)
    model = fit(points, ModelsConfig(voxel_size_m=size_m))
    counts = np.bincount(model.labels[np.isfinite(points[:, 0]) & (labels == tabletop.TABLE)])
    assert counts.max() > 0.95 * counts.sum()


@pytest.mark.parametrize(
    ('sigma', 'outliers', 'least'),
    [
        (7e-3, 0.0, 0.99),
        (15e-3, 0.0, 0.99),
        (2e-3, 0.1, 0.98),
        (5e-3, 0.1, 0.97),
        (1e-2, 0.1, 0.9),
    ],
)
def test_noisy_planes_are_found_whole_also_among_outliers(sigma, outliers, least):
    rng = np.random.default_rng(2)
    cloud = sheet(2.0, 2.0, 0.01, (1.0, 2.0, -3.0), (0.3, 0.2, 3.0), sigma)
    low, high = [-1.0, -1.0, -0.1], [1.0, 1.0, 0.1]
    others = rng.uniform(low, high, (int(outliers * len(cloud)), 3))
    z = np.array([1.0, 2.0, -3.0]) / math.sqrt(14.0)
    x = np.cross([1.0, 0.0, 0.0], z) / np.linalg.norm(np.cross([1.0, 0.0, 0.0], z))
    others = others @ np.stack([x, np.cross(z, x), z]) + [0.3, 0.2, 3.0]
    above = np.array([0.3, 0.2, 3.0]) + 3.0 * z
    model = fit(np.concatenate([cloud, others]), ModelsConfig(voxel_size_m=A), above)
    on_sheet = model.labels[: len(cloud)]
    largest = max(model.planes, key=lambda plane: plane.num_points)
    assert (on_sheet == largest.id).mean() > least
    assert largest.normal @ z == pytest.approx(1.0, abs=1e-3)
    assert model.noise[0] + model.noise[1] * 9.0 == pytest.approx(sigma, rel=0.35)


def round_cloud(radius_m, *, ball, whole, number=60_000, sigma=5e-3):
    """Return noisy points on a ball or cylinder before the origin, or on its front half."""
    rng = np.random.default_rng(8)
    if ball:
        out = rng.standard_normal((number, 3))
        out /= np.linalg.norm(out, axis=1)[:, None]
        axis = np.zeros((number, 3))
    else:
        angle = rng.uniform(-math.pi, math.pi, number)
        out = np.column_stack([np.sin(angle), np.zeros(number), np.cos(angle)])
        axis = np.outer(rng.uniform(-0.3, 0.3, number), [0.0, 1.0, 0.0])
    if not whole:
        out[:, 2] = -np.abs(out[:, 2])
    points = axis + out * (radius_m + sigma * rng.standard_normal(number))[:, None]
    turned = points @ np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]).T
    return np.add(turned, [0.1, 0.05, 1.5])


@pytest.mark.parametrize('size_m', [0.01, 0.02, 0.03])
@pytest.mark.parametrize('whole', [False, True])
@pytest.mark.parametrize(('ball', 'radius_m'), [(False, 0.1), (False, 0.3), (True, 0.2)])
def test_noisy_round_objects_are_curved_patches(ball, radius_m, whole, size_m):
    points = round_cloud(radius_m, ball=ball, whole=whole)
    model = fit(points, ModelsConfig(voxel_size_m=size_m))
    curved = (model.labels >= len(model.planes)) & (model.labels < len(model.patches))
    assert curved.mean() > 0.95
    assert len(model.patches) <= 18
    for surface in model.surfaces:
        assert surface.rms_m < 0.014


def test_a_bent_sheet_is_one_surface_and_a_roof_two_planes():
    x, y = (part.ravel() for part in np.meshgrid(*2 * [np.arange(-0.3, 0.3, 0.004)]))
    noise = 2e-3 * np.random.default_rng(9).standard_normal(len(x))
    shapes = (-0.5 * x**2 / 0.5, 0, 1), (-0.3 * np.abs(x), 2, 0), (-0.4 * np.abs(x), 2, 0)
    for heights, planes, surfaces in shapes:
        model = fit(
            np.column_stack([x, y, heights + noise]), ModelsConfig(voxel_size_m=0.02), (0, 0, 2.0)
        )
        assert (len(model.planes), len(model.surfaces)) == (planes, surfaces)
        assert np.bincount(model.labels).max() > 0.49 * len(x)


def test_rings_of_a_lidar_on_a_floor_are_one_plane():
    rng = np.random.default_rng(10)
    below = np.radians(np.arange(1.7, 40.0, 1.3))  # 30 beams to 60 m, gaps of 0.1 to 26 m
    angle = np.radians(np.arange(0.0, 360.0, 0.2))
    reach = np.repeat(1.8 / np.tan(below), len(angle))
    angle = np.tile(angle, len(below))
    floor = np.column_stack(
        [reach * np.cos(angle), reach * np.sin(angle), np.full(len(angle), -1.8)]
    )
    floor *= (
        1.0 + 0.01 * rng.standard_normal((len(floor), 1)) / np.linalg.norm(floor, axis=1)[:, None]
    )
    model = fit(floor, ModelsConfig(voxel_size_m=0.3))
    counts = np.bincount(model.labels)
    assert len(model.patches) == 1
    assert counts.max() > 0.99 * counts.sum()
    assert abs(model.patches[int(counts.argmax())].normal[2]) == pytest.approx(1.0, abs=1e-4)


def test_clutter_before_a_depth_camera_is_on_no_plane():
    rng = np.random.default_rng(5)
    wall = sheet(1.0, 1.6, 0.008, centre=(0.0, 0.0, 1.0), sigma=1e-3)
    clutter = rng.uniform([-0.5, 0.5, 0.6], [0.5, 1.0, 1.2], (len(wall) // 10, 3))
    config = ModelsConfig(voxel_size_m=0.03, noise_per_range_sq=1e-3)
    model = fit(np.concatenate([wall, clutter]), config)
    assert len(model.planes) == 1
    assert (model.labels[: len(wall)] == 0).all()


@pytest.mark.parametrize('seed', [0, 1])
def test_leaves_before_a_lidar_are_on_no_plane(seed):
    rng = np.random.default_rng(seed)
    crown = rng.uniform([10.0, -3.0, 0.5], [16.0, 3.0, 3.5], (12_000, 3))
    xy = rng.uniform([3.0, -8.0], [25.0, 8.0], (30_000, 2))
    floor = np.column_stack([xy, 0.02 * rng.standard_normal(len(xy)) - 1.5])
    model = fit(np.concatenate([crown, floor]), ModelsConfig(voxel_size_m=0.3))
    is_on_patch = model.labels < len(model.patches)
    assert is_on_patch[: len(crown)].mean() < 0.05
    assert is_on_patch[len(crown) :].mean() > 0.99


def crates():
    """Return points of 36 cubes of 0.7 m, and the face of each point."""
    rng, parts = np.random.default_rng(3), []
    for i, j in np.ndindex(6, 6):
        middle = np.array([10.0 + 1.7 * i, 1.7 * j - 4.0, 0.3]) + rng.uniform(-0.2, 0.2, 3)
        for axis, side in np.ndindex(3, 2):
            face = rng.uniform(-0.35, 0.35, (120, 3))
            face[:, axis] = 0.7 * side - 0.35
            parts.append(face + middle)
    points = np.concatenate(parts)
    return points + 0.003 * rng.standard_normal(points.shape), np.arange(len(points)) // 120


def test_faces_narrower_than_two_voxels_are_patches():
    points, face = crates()
    model = fit(points, ModelsConfig(voxel_size_m=0.5))
    counts = [np.bincount(face[model.labels == patch.id]) for patch in model.patches]
    assert sum(count.sum() for count in counts) > 0.9 * len(points)
    assert sum(count.max() for count in counts) > 0.7 * len(points)


@pytest.mark.parametrize(
    ('name', 'flat', 'scatter', 'residual_mm'),
    [
        ('velodyne_vls128_street', 0.95, 0.33, 150.0),
        ('ouster_os0_128', 0.94, 0.25, 60.0),
        ('ouster_os2_128', 0.94, 0.25, 60.0),
        ('pcl_room_scan2', 0.98, 0.4, 35.0),
    ],
)
def test_flat_points_of_real_scans_are_on_patches_and_leaves_are_not(
    data_folder, name, flat, scatter, residual_mm
):
    (file,) = (data_folder / 'data' / 'scans').glob(f'{name}.*')
    points = np.asarray(read_scan(file)[0], np.float32).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]
    model = fit(points, ModelsConfig(voxel_size_m=0.3))
    patch = np.where(model.labels < len(model.patches), model.labels, -1)
    near = points[cKDTree(points).query(points, 20)[1]].astype(np.float64)
    near -= near.mean(axis=1, keepdims=True)
    least, _, most = np.linalg.eigvalsh(np.einsum('nki,nkj->nij', near, near) / 20).T
    assert (patch[least < 0.02 * most] >= 0).mean() > flat
    assert (patch[(least > 0.1 * most) & (least > 0.1**2)] >= 0).mean() < scatter
    squares = 0.0
    for number in np.unique(patch[patch >= 0]):
        own = points[patch == number].astype(np.float64)
        if len(own) > 3:
            squares += np.linalg.eigvalsh(np.cov(own.T, bias=True))[0] * len(own)
    assert 1e3 * np.sqrt(squares / (patch >= 0).sum()) < residual_mm


def test_an_organised_cloud_has_labels_for_all_its_points():
    cloud = np.full((40, 50, 3), np.nan, np.float32)
    cloud[5:, :, :] = sheet(1.0, 0.7, 0.02)[: 35 * 50].reshape(35, 50, 3)
    model = fit(cloud, ModelsConfig(voxel_size_m=A))
    assert model.labels.shape == (2000,)
    assert (model.labels[:250] == -1).all()
    assert (model.labels[250:] >= 0).all()


@pytest.mark.parametrize('step_m', [0.0, -0.1, math.nan, math.inf])
def test_a_spacing_of_samples_that_is_no_distance_is_refused(step_m):
    points = np.random.default_rng(3).uniform(0.0, 1.0, (2000, 3)) * [1.0, 1.0, 0.0]
    with pytest.raises(ValueError, match=f'step_m: {step_m:g}, expected a positive distance'):
        fit(points, ModelsConfig(voxel_size_m=0.1)).resample(step_m)


def test_samples_of_gaussians_end_at_three_sigma_and_have_their_moments():
    rng = np.random.default_rng(8)
    blob = rng.standard_normal((30_000, 3)) * [0.3, 0.2, 0.1]
    model = fit(blob, ModelsConfig(voxel_size_m=0.02, kinds='gaussians', min_points=100_000))
    (mean,), (covariance,) = model.gaussians.mean, model.gaussians.covariance
    drawn = model.resample()
    assert len(drawn) == model.num_thinned
    away = drawn - mean
    distance_sq = np.einsum('ij,jk,ik->i', away, np.linalg.inv(covariance), away)
    assert distance_sq.max() <= 9.0 + 1e-9
    assert drawn.mean(axis=0) == pytest.approx(mean, abs=0.01)


@pytest.mark.parametrize('size_m', [0.07, 0.1, 0.3])
def test_points_across_surfels_stay_in_their_voxels(size_m):
    surfel_map = SurfelMap(size_m)
    surfel_map.add(sheet(10.0, 10.0, 0.02, normal=(0.3, 0.2, 1.0), centre=(30.0, -20.0, 1.0)))
    surfels = surfel_map.surfels(min_points=3)
    surfels = surfels.select(np.flatnonzero(np.isfinite(surfels.planarity)))
    points = surfel_points(surfels, size_m).reshape(-1, 9, 3)
    assert len(points) == len(surfels) > 1000
    assert (np.floor(points / size_m) == surfels.voxel_index[:, None]).all()


@pytest.mark.parametrize(
    ('points', 'viewpoint'),
    [
        (np.zeros((3, 2)), (0, 0, 0)),
        (np.zeros(3), (0, 0, 0)),
        (np.zeros((4, 3), int), (0, 0, 0)),
        (np.zeros((4, 3)), (0, 0)),
        (np.zeros((4, 3)), (0, 0, math.nan)),
    ],
)
def test_invalid_clouds_are_refused(points, viewpoint):
    with pytest.raises(ModelError, match='expected'):
        fit(points, None, viewpoint)


@pytest.mark.parametrize(
    'settings', [{'profile': 'quick'}, {'voxel_size_m': 0.0}, {'min_density_radius': 3.1}]
)
def test_settings_out_of_bounds_are_refused(settings):
    with pytest.raises(ConfigError, match=next(iter(settings))):
        ModelsConfig(**settings)


def test_other_units_are_warned_about(caplog):
    points = np.random.default_rng(5).uniform(-4.0, 4.0, (3000, 3)) * [1.0, 1.0, 0.0]

    fit(points)
    assert not caplog.records
    fit(100.0 * points)
    assert 'millimetres or centimetres?' in caplog.text


def test_wide_groups_are_divided_where_they_have_gaps():
    rng = np.random.default_rng(0)
    ends = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.9]])
    points = np.concatenate([rng.normal(end, 0.01, (20, 3)) for end in ends])
    triple = np.array([[5.0, 0.0, 0.0], [6.0, 0.0, 0.0], [7.0, 0.0, 0.0]])  # too few to divide
    every = np.concatenate([points, triple])
    group = np.repeat([0, 1], [60, 3])
    means, all_points = narrow_groups((every, group), (every[::-1], group[::-1]), 0.06)
    assert (means == all_points[::-1]).all()
    names = [set(means[a:b].tolist()) for a, b in ((0, 20), (20, 40), (40, 60), (60, 63))]
    assert [len(name) for name in names] == [1, 1, 1, 1]
    assert set.union(*names) == {0, 1, 2, 3}


def test_no_gaussian_fills_the_space_between_its_points():
    """Poles before a wall were one Gaussian of 11 voxels, as growth left them together."""
    wall = sheet(3.0, 2.0, 0.01, (1.0, 0.0, 0.0), (3.0, 0.0, 0.0), sigma=0.002)
    rng = np.random.default_rng(0)
    strays = np.concatenate([rng.normal(at, 0.02, (30, 3)) for at in POLES])
    points = np.concatenate([wall, strays]).astype(np.float32)
    model = fit(points, ModelsConfig(voxel_size_m=A))
    gaussians = model.gaussians
    sigma = np.sqrt(np.linalg.eigvalsh(gaussians.covariance)[:, 2])
    assert (sigma[gaussians.num_points >= 4] <= 1.5 * A * (1 + 1e-9)).all()
    assert len(gaussians) > 1
    assert model.num_thinned == sum(
        [patch.num_points for patch in model.patches] + gaussians.num_points.tolist()
    )
    labels = model.labels[len(wall) :]
    assert np.isin(labels, gaussians.id).mean() > 0.9
    on = labels >= gaussians.id.min()
    away = strays[on] - gaussians.mean[labels[on] - gaussians.id.min()]
    assert np.linalg.norm(away, axis=1).max() < 8 * A


POLES = [(2.0, y, z) for y in (-0.4, 0.0, 0.4) for z in (-0.3, 0.3)]
"""Places of small clusters before a wall."""
