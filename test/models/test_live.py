# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Models that follow a map equal those of the present map, whatever its history.

Fixed seeds; the random sequences add and remove scans, clear the map, and update in between.

(Longer than other files: every test drives the same scenes.)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper.config import ModelsLayerConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models.live import LiveModels
from test.models.live_scenes import (
    groups,
    id_at,
    ids,
    live,
    of_points,
    SETTINGS,
    VOXEL_M,
)
from test.models.scenes import (
    BALL,
    BALL_RADIUS,
    CENTRE,
    CYLINDER,
    FLAT,
    room,
    sheet,
    VIEW,
)


@pytest.fixture(scope='module')
def camera():
    points, lies_on = room(320, 240)
    return points.astype(np.float64), lies_on


@pytest.fixture(scope='module')
def noisy():
    return room(320, 240, noise_per_range_sq=1e-3)[0].astype(np.float64)


def cells(x, y, z=0.0, spacing=0.02):
    """Return points on a level rectangle [x0, x1) by [y0, y1)."""
    places = np.meshgrid(np.arange(*x, spacing), np.arange(*y, spacing), indexing='ij')
    return np.stack([*places, np.full_like(places[0], z)], -1).reshape(-1, 3) + 1e-3


def test_floor_walls_and_faces_are_one_plane_each(camera):
    points, lies_on = camera
    _, models = of_points(points, VIEW, voxel_size_m=0.1)
    owners = []
    for plane in models.model.planes:
        mine = models.surfels.position[models.model.labels == plane.id]
        near = ((mine[:, None] - points[None, ::7]) ** 2).sum(-1).argmin(1)
        counts = np.bincount(lies_on[::7][near], minlength=8)
        assert counts.max() > 0.97 * counts.sum()
        owners.append(int(counts.argmax()))
        assert plane.rms_m < 1e-3
    assert sorted(owners) == sorted(FLAT)


def test_cylinder_and_ball_are_surfaces_within_millimetres(camera):
    points, _ = camera
    _, models = of_points(points, VIEW, voxel_size_m=0.1)
    surfaces = models.model.surfaces
    assert 4 <= len(surfaces) <= 6  # at most two for the cylinder, four for the ball
    for surface in surfaces:
        cloud = surface.samples(0.02)
        ball = np.abs(np.linalg.norm(cloud - CENTRE, axis=1) - BALL_RADIUS)
        round_it = np.abs(np.linalg.norm(cloud[:, :2] - (-0.6, 2.3), axis=1) - 0.35)
        assert np.sqrt(np.mean(np.minimum(ball, round_it) ** 2)) < 7e-3
        local = surface.to_local(points)
        inside = surface.grid.contains(local[:, :2]) & (np.abs(local[:, 2]) < 0.2)
        assert inside.any()
    assert (CYLINDER, BALL) == (6, 7)


@pytest.mark.parametrize('seed', range(6))
def test_incremental_models_equal_a_batch_after_random_changes(noisy, seed):
    rng = np.random.default_rng(seed)
    settings = ModelsLayerConfig(
        min_points=4,
        noise_m=float(rng.choice([0.0, 0.01])),
        min_voxels=int(rng.integers(1, 6)),
    )
    surfel_map = SurfelMap(VOXEL_M)
    models, held, known = LiveModels(settings, surfel_map), [], set()
    for step in range(8):
        for _ in range(rng.integers(1, 4)):
            draw = rng.random()
            if held and draw < 0.45:
                surfel_map.remove(held.pop(rng.integers(len(held))))
            elif draw < 0.5 and step > 4:
                surfel_map.clear()
                held.clear()
            else:
                part = noisy[rng.random(len(noisy)) < rng.choice([0.02, 0.1, 0.5])]
                if rng.random() < 0.5:
                    near = part[rng.integers(len(part))]
                    part = part[((part - near) ** 2).sum(axis=1) < 1.0]
                moved = part + rng.normal(0.0, 0.02, 3) * (rng.random() < 0.3)
                held.append(surfel_map.add(moved, origin=VIEW))
        update = models.update()
        assert known.isdisjoint(update.created)
        assert known.issuperset(update.updated)
        assert known.issuperset(update.removed)
        known = (known | set(update.created)) - set(update.removed)
        assert known == ids(models) == set(models.versions)
        assumed = replace(settings, noise_m=models.noise_m or 1e-9)  # not to be estimated again
        assert groups(models) == groups(live(surfel_map.copy(), assumed))


def test_two_runs_give_the_same_ids_and_numbers(noisy):
    runs = []
    for _ in range(2):
        surfel_map = SurfelMap(VOXEL_M)
        models = LiveModels(SETTINGS, surfel_map)
        for part in np.array_split(noisy, 3):
            surfel_map.add(part, origin=VIEW)
            models.update()
        runs.append(models.model)
    assert [p.id for p in runs[0].patches] == [p.id for p in runs[1].patches]
    np.testing.assert_array_equal(runs[0].labels, runs[1].labels)
    for one, other in zip(runs[0].patches, runs[1].patches, strict=True):
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.grid.cuts, other.grid.cuts)


def test_geometry_after_many_updates_equals_a_batch(noisy):
    surfel_map = SurfelMap(VOXEL_M)
    models = LiveModels(SETTINGS, surfel_map)
    for part in np.array_split(np.random.default_rng(5).permutation(noisy), 12):
        surfel_map.add(part, origin=VIEW)
        models.update()
    fresh = live(surfel_map.copy())
    pairs = {
        frozenset(np.flatnonzero(m.model.labels == p.id).tolist()): p
        for m in (fresh,)
        for p in m.model.planes
    }
    assert len(pairs) == len(models.model.planes) > 3
    by_voxel = {
        frozenset(map(tuple, fresh.surfels.voxel_index[list(rows)].tolist())): plane
        for rows, plane in pairs.items()
    }
    for plane in models.model.planes:
        mine = models.surfels.voxel_index[models.model.labels == plane.id]
        twin = by_voxel[frozenset(map(tuple, mine.tolist()))]
        # a fifth of what counts as a change of a voxel
        assert np.abs(plane.mean - twin.mean).max() < 0.02
        corners = plane.samples(0.2)
        assert np.abs((corners - twin.mean) @ twin.normal).max() < 0.01
        assert plane.grid.area_m2(4) == pytest.approx(twin.grid.area_m2(4), rel=0.15)


def test_ids_stay_while_little_changes(camera):
    points, _ = camera
    surfel_map, models = of_points(points, VIEW, voxel_size_m=0.1)
    before = {p.id: p for p in models.model.patches}
    frames = {number: p.R_patch_map for number, p in before.items()}
    rng = np.random.default_rng(0)
    for _ in range(3):
        surfel_map.add(points[rng.random(len(points)) < 0.2], origin=VIEW)
        update = models.update()
        assert not set(update.created) & set(before)
        assert not update.merged
        assert not update.split
    assert {p.id for p in models.model.patches} == set(before)
    for plane in models.model.planes:
        np.testing.assert_array_equal(plane.R_patch_map, frames[plane.id])
    for surface in models.model.surfaces:
        assert surface.normal @ frames[surface.id][2] > 0.999


def test_immaterial_changes_are_not_reported():
    surfel_map, models = of_points(cells((0, 2), (0, 2)))
    versions = dict(models.versions)
    assert models.update().num_changed == 0
    surfel_map.add(cells((0.6, 1.2), (0.6, 1.2))[::37], origin=(0, 0, 5))
    update = models.update()
    assert update.num_changed > 0
    assert (update.created, update.updated, update.removed) == ((), (), ())
    assert models.versions == versions


def test_a_bridge_merges_two_planes_and_its_end_splits_them():
    surfel_map = SurfelMap(VOXEL_M)
    surfel_map.add(cells((0, 2.4), (0, 2)), origin=(0, 0, 5))
    surfel_map.add(cells((3.6, 4.8), (0, 2)), origin=(0, 0, 5))
    models = LiveModels(SETTINGS, surfel_map)
    assert len(models.update().created) == 2
    large, small = id_at(models, (1, 1, 0)), id_at(models, (4, 1, 0))
    bridge = surfel_map.add(cells((2.4, 3.6), (0.5, 1.5)), origin=(0, 0, 5))
    update = models.update()
    assert update.merged == ((small, large),)
    assert (update.updated, update.removed) == ((large,), (small,))
    assert models.versions == {large: 2}
    area = models.model.planes[0].grid.area_m2()
    assert area == pytest.approx(2.4 * 2 + 1.2 * 2 + 1.2, rel=0.06)

    surfel_map.remove(bridge)
    update = models.update()
    (new,) = update.created
    assert update.split == ((large, new),)
    assert update.merged == ()
    assert models.versions == {large: 3, new: 1}
    assert id_at(models, (1, 1, 0)) == large
    assert id_at(models, (4, 1, 0)) == new


def test_a_plane_that_leaves_is_removed_and_its_id_does_not_come_back():
    surfel_map, models = of_points(cells((0, 2), (0, 2)))
    (first,) = ids(models)
    moments = surfel_map.add(cells((5, 7), (0, 2)), origin=(0, 0, 5))
    (second,) = models.update().created
    surfel_map.remove(moments)
    assert models.update().removed == (second,)
    surfel_map.insert(moments)
    (third,) = models.update().created
    assert len({first, second, third}) == 3


@pytest.mark.parametrize('at_once', [True, False])
def test_a_cleared_map_clears_the_models(at_once):
    surfel_map, models = of_points(cells((0, 2), (0, 2)))
    before = ids(models)
    surfel_map.clear()
    if at_once:
        models.clear()
        assert ids(models) == set()
    assert models.update().removed == tuple(sorted(before))
    assert (len(models.surfels), models.model.patches) == (0, [])
    surfel_map.add(cells((0, 2), (0, 2)), origin=(0, 0, 5))
    assert before.isdisjoint(models.update().created)
    assert len(models.model.planes) == 1


def test_a_restored_map_keeps_its_ids():
    surfel_map, models = of_points(cells((0, 2), (0, 2)))
    before, content = ids(models), surfel_map.moments()
    surfel_map.clear()
    surfel_map.add(cells((-3, -1), (-3, -1)), origin=(0, 0, 5))  # rows are others now
    surfel_map.insert(content)
    update = models.update()
    assert update.removed == ()
    assert before < ids(models)
    assert update.num_changed == surfel_map.num_voxels
    assert groups(models) == groups(live(surfel_map))


def test_an_empty_map_has_no_models():
    models = live(SurfelMap(0.5))
    assert models.summary() == {'planes': 0, 'surfaces': 0, 'gaussians': 0, 'bytes': 0}
    assert len(models.model.labels) == len(models.surfels) == 0
    assert models.update().created == ()


@pytest.mark.parametrize(
    ('points', 'gaussians', 'planes'),
    [
        (np.zeros((1, 3)), 0, 0),
        (np.zeros((50, 3)), 1, 0),
        (np.linspace([0, 0, 0], [0.1, 0.05, 0.02], 50), 1, 0),
        (np.linspace([0, 0, 0], [0, 5, 0], 2000) + 0.05, 43, 0),
        (cells((0, 1), (0, 1)), 0, 1),
        (np.repeat(cells((0, 1), (0, 1)), 3, axis=0), 0, 1),
    ],
    ids=['one point', 'equal points', 'a short line', 'a long line', 'a plane', 'duplicates'],
)
@pytest.mark.filterwarnings('error')
def test_degenerate_input_has_a_result(points, gaussians, planes):
    _, models = of_points(points)
    assert len(models.model.gaussians) == gaussians
    assert len(models.model.planes) == planes
    assert models.model.surfaces == []
    assert np.isfinite(models.model.resample()).all()
    models.map.clear()
    models.update()


def test_a_sheet_whose_normals_have_either_sign_is_one_plane():
    points = sheet(3.0, 3.0, 0.02, normal=(1.0, -1.0, 0.0), centre=(0.3, 0.2, 0.1), sigma=2e-3)
    surfel_map = SurfelMap(VOXEL_M)
    surfel_map.add(points)  # without a viewpoint
    models = live(surfel_map)
    signs = np.sign(models.surfels.normal @ (1.0, -1.0, 0.0))
    assert set(signs[np.isfinite(signs)].tolist()) >= {-1.0, 1.0}
    assert [len(models.model.planes), len(models.model.surfaces)] == [1, 0]
    assert models.model.planes[0].grid.area_m2() == pytest.approx(9.0, rel=0.1)


def test_bent_sheet_without_viewpoint_is_one_surface():
    x, y = np.meshgrid(np.arange(-1.5, 1.5, 0.02), np.arange(-1.5, 1.5, 0.02), indexing='ij')
    z = 0.12 * x**2
    along = (x + z) / np.sqrt(2.0)  # turned so that its normals change sign somewhere
    points = np.stack([along, (z - x) / np.sqrt(2.0), y], -1).reshape(-1, 3)
    surfel_map = SurfelMap(VOXEL_M)
    surfel_map.add(points)
    models = live(surfel_map)
    (surface,) = models.model.surfaces
    assert models.model.planes == []
    local = surface.to_local(points)
    inside = surface.grid.contains(local[:, :2])
    error = local[inside, 2] - surface.heights(local[inside, :2])
    assert inside.mean() > 0.99
    assert np.sqrt(np.mean(error**2)) < 2e-3
    assert surface.rms_m < 3e-3


@pytest.mark.parametrize(('slope', 'planes', 'surfaces'), [(0.3, 0, 1), (0.4, 2, 0)])
def test_roofs_are_two_planes_from_between_33_and_44_degrees_on(slope, planes, surfaces):
    x, y = (part.ravel() for part in np.meshgrid(*2 * [np.arange(-0.3, 0.3, 0.004)]))
    z = 2e-3 * np.random.default_rng(9).standard_normal(len(x)) - slope * np.abs(x)
    points, settings = np.column_stack([x, y, z]), ModelsLayerConfig()
    _, models = of_points(points, (0.0, 0.0, 2.0), settings, 0.02)
    assert (len(models.model.planes), len(models.model.surfaces)) == (planes, surfaces)


def spiral(radius_m):
    """Return points on a ramp 2 m wide of more than two turns, 1.57 m above each other."""
    turn = np.arange(0, 14, 0.06 / radius_m)
    turn, out = np.meshgrid(turn, radius_m + np.arange(0.0, 2.0, 0.06), indexing='ij')
    x, y = out * np.cos(turn), out * np.sin(turn)
    return np.stack([x, y, 0.25 * turn], -1).reshape(-1, 3)


def test_a_ramp_over_itself_is_cut():
    _, models = of_points(spiral(3.0), origin=(0, 0, 30), voxel_size_m=0.2)
    patches = [p for p in models.model.patches if p.num_points > 1000]
    assert len(patches) >= 2
    for patch in patches:
        mine = models.surfels.position[models.model.labels == patch.id]
        local = patch.to_local(mine)
        column = np.floor(local[:, :2] / 0.2).astype(int)
        for place in np.unique(column, axis=0)[::10]:
            heights = local[(column == place).all(axis=1), 2]
            assert heights.max() - heights.min() < 0.9  # the next turn is 1.57 m higher


def test_planes_grow_over_gaps_to_the_sparse_voxels_on_them():
    rng = np.random.default_rng(3)
    near, beyond = cells((0, 2.4), (0, 2.4)), cells((6.0, 7.2), (0, 2.4))
    far = rng.uniform([2.4, 0, 0], [6, 2.4, 0], (150, 3))
    above = rng.uniform([2.4, 0, 0.15], [6, 2.4, 0.6], (60, 3))
    points = np.concatenate([near, beyond, far, above]) + 1e-3
    points[:, 2] += 2e-3 * rng.standard_normal(len(points))
    _, models = of_points(points)
    (plane,) = models.model.planes
    far, above = points[-210:-60], points[-60:]
    assert np.mean([id_at(models, place) == plane.id for place in far]) > 0.95
    assert id_at(models, beyond[0]) == plane.id
    assert plane.id not in {id_at(models, place) for place in above}


@pytest.mark.parametrize(
    ('radius_m', 'spacing', 'patches'), [(0.3, 0.03, 0), (0.3, 0.005, 1), (np.inf, 0.03, 1)]
)
def test_small_curved_charts_are_patches_if_they_have_many_points(radius_m, spacing, patches):
    points = cells((0.02, 0.34), (0.02, 0.34), 0.06, spacing)  # three voxels a side
    points[:, 2] -= 0.5 * (points[:, 0] - 0.18) ** 2 / radius_m
    _, models = of_points(points)
    assert len(models.model.patches) == patches
    assert len(models.model.gaussians) == 9 * (1 - patches)


def test_planes_hold_the_exact_moments_of_their_points():
    points = sheet(2.0, 2.0, 0.02, normal=(0.2, 0.1, 1.0), sigma=3e-3)
    settings = ModelsLayerConfig(min_points=1 + 2, noise_m=0.005)
    _, models = of_points(points, settings=settings)
    (plane,) = models.model.planes
    mine = models.model.labels == plane.id
    counts, means = models.surfels.num_points[mine], models.surfels.position[mine]
    if counts.sum() == len(points):
        np.testing.assert_allclose(plane.mean, points.mean(axis=0), atol=1e-5)
        np.testing.assert_allclose(plane.covariance, np.cov(points.T), atol=1e-5)
    assert plane.num_points == counts.sum()
    np.testing.assert_allclose(plane.mean, counts @ means / counts.sum(), atol=1e-12)
    assert abs(plane.normal @ np.array([0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0])) > 0.9999
    assert plane.rms_m == pytest.approx(3e-3, rel=0.1)
