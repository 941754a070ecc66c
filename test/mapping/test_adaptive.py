# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Adaptive surfels: scenes with known answers, the slow twin, and random programs."""

import numpy as np
import pytest

from surfel_mapper.errors import MapError
from surfel_mapper.mapping.adaptive import AdaptiveCut
from surfel_mapper.mapping.surfel_map import SurfelMap
from test.mapping.adaptive_twin import twin_cut
from test.mapping.made_maps import made_up

BASE_M = 0.125
NOISE_M = 0.005


def sheet(low, high, axis, at, step_m=0.012, seed=1):
    """Return points on a rectangle across an axis, with noise: (2,) corners on the other axes."""
    rng = np.random.default_rng(seed)
    u, v = (np.arange(a + 0.5 * step_m, b, step_m) for a, b in zip(low, high, strict=True))
    points = np.stack([a.ravel() for a in np.meshgrid(u, v)], axis=1)
    points = np.insert(points, axis, at, axis=1)
    points[:, axis] += rng.normal(scale=NOISE_M, size=len(points))
    return points


def map_of(*parts, origin=(0.1, 0.2, 5.0), voxel_size_m=BASE_M):
    surfel_map = SurfelMap(voxel_size_m)
    for points in parts:
        surfel_map.add(points, origin)
    return surfel_map


def angles_deg(surfels, direction):
    """Return the angles of normals to a direction, in [0, 90]."""
    dots = np.abs(surfels.normal @ direction / np.linalg.norm(direction))
    return np.degrees(np.arccos(np.minimum(dots, 1.0)))


def members(surfels, points):
    """Return the row of the surfel that holds each point."""
    low = surfels.voxel_index * surfels.size[:, None]
    inside = [
        np.all((points >= corner) & (points < corner + size), axis=1)
        for corner, size in zip(low, surfels.size, strict=True)
    ]
    assert (np.sum(inside, axis=0) == 1).all()  # each point in exactly one
    return np.argmax(inside, axis=0)


def check(surfel_map, points):
    """Check that the cut partitions the points and equals that of the twin; return it."""
    surfels = surfel_map.adaptive()
    assert surfels.num_points.sum() == surfel_map.num_points
    members(surfels, points[:: max(len(points) // 500, 1)])
    level = np.log2(surfels.size / surfel_map.voxel_size_m).astype(int).tolist()
    index = map(tuple, surfels.voxel_index.tolist())
    cut = set(zip(level, index, surfels.num_points.tolist(), strict=True))
    assert cut == twin_cut(surfel_map)
    return surfels


def test_floor_becomes_cells_of_two_metres_at_negative_indices_too():
    floor = sheet((-4, -2), (0, 2), 2, 0.06)
    surfels = check(map_of(floor), floor)
    assert sorted(surfels.size.tolist()) == [2.0] * 4
    assert angles_deg(surfels, [0, 0, 1]).max() < 0.1
    assert (surfels.normal[:, 2] > 0.0).all()  # towards the sensor
    assert sorted(map(tuple, surfels.voxel_index.tolist())) == [
        (-2, -1, 0), (-2, 0, 0), (-1, -1, 0), (-1, 0, 0),
    ]  # fmt: skip


def test_inclined_floor_is_one_plane_too():
    floor = sheet((-2, -2), (2, 2), 2, 0.0)
    floor[:, 2] += 0.21 * floor[:, 0] + 0.13 * floor[:, 1]
    surfels = check(map_of(floor), floor)
    in_large = surfels.num_points[surfels.size >= 1.0].sum()
    assert in_large > 0.7 * len(floor)  # small cells where voxels are cut by few points
    assert angles_deg(surfels[surfels.size >= 0.5], [-0.21, -0.13, 1.0]).max() < 0.5


def test_edge_of_floor_and_wall_keeps_both_normals():
    floor, wall = sheet((0, 0), (2, 2), 2, 0.06), sheet((0, 0), (2, 2), 0, 1.06)
    both = np.concatenate([floor, wall])
    surfels = check(map_of(both), both)
    to_planes = np.minimum(angles_deg(surfels, [0, 0, 1]), angles_deg(surfels, [1, 0, 0]))
    assert to_planes[surfels.size > BASE_M].max() < 1.0
    mixed = surfels[to_planes > 5.0]
    assert (np.abs(mixed.position - [1.06, 1.0, 0.06])[:, [0, 2]] < BASE_M).all()


@pytest.mark.parametrize('step_m', [0.08, 0.12, 0.3])
@pytest.mark.parametrize('at_m', [0.5, 0.4375, 1.0, 0.9])
def test_step_and_curb_are_in_no_large_cell(step_m, at_m):
    low, high = sheet((0, 0), (at_m, 2), 2, 0.03), sheet((at_m, 0), (2, 2), 2, 0.03 + step_m)
    face = sheet((0, 0.03), (2, 0.03 + step_m), 0, at_m)
    points = np.concatenate([low, high, face])
    surfels = check(map_of(points), points)
    large = surfels[surfels.size >= (0.25 if step_m < 0.2 else 0.5)]
    to_planes = np.minimum(angles_deg(large, [0, 0, 1]), angles_deg(large, [1, 0, 0]))
    assert to_planes.max() < 3.0
    assert large.thickness.max() < 0.02  # some of the face is in a cell beside it
    assert large.num_points.sum() > 0.4 * len(points)


def test_step_of_4_cm_needs_a_lower_thickness():
    points = np.concatenate([sheet((0, 0), (1, 2), 2, 0.04), sheet((1, 0), (2, 2), 2, 0.08)])
    surfels = map_of(points).adaptive(max_thickness_m=0.015)
    large = surfels[surfels.size >= 0.25]
    assert angles_deg(large, [0, 0, 1]).max() < 1.0
    assert large.thickness.max() < 2.0 * NOISE_M


def test_stairs_stay_treads_and_risers():
    treads = [sheet((0.28 * i, 0), (0.28 * i + 0.28, 2), 2, 0.17 * i + 0.05) for i in range(6)]
    risers = [sheet((0, 0.17 * i - 0.12), (2, 0.17 * i + 0.05), 0, 0.28 * i) for i in range(1, 6)]
    points = np.concatenate([*treads, *risers])
    surfels = check(map_of(points), points)
    to_planes = np.minimum(angles_deg(surfels, [0, 0, 1]), angles_deg(surfels, [1, 0, 0]))
    assert surfels.num_points[to_planes < 5.0].sum() > 0.5 * len(points)  # the others are mixed
    assert surfels.size.max() <= 0.25


def test_thin_wall_splits_into_its_sides():
    """At a border of voxels, 10 cm thick; within one voxel the thickness tells."""
    at_border = map_of(sheet((0, 0), (2, 2), 0, 0.95), origin=(-5, 1, 1))
    at_border.add(sheet((0, 0), (2, 2), 0, 1.05), (5, 1, 1))
    surfels = at_border.adaptive()
    assert surfels.thickness.max() < 2.0 * NOISE_M
    assert angles_deg(surfels, [1, 0, 0]).max() < 5.0
    within = map_of(sheet((0, 0), (2, 2), 0, 1.02), origin=(-5, 1, 1))
    within.add(sheet((0, 0), (2, 2), 0, 1.105), (5, 1, 1))
    surfels = within.adaptive()
    assert (surfels.size == BASE_M).all()
    assert (surfels.thickness > 0.03).all()


def test_pole_and_corner_stay_small():
    rng = np.random.default_rng(1)
    angle, z = rng.uniform(0, 2 * np.pi, 5000), rng.uniform(0, 2, 5000)
    pole = np.stack([0.55 + 0.1 * np.cos(angle), 0.55 + 0.1 * np.sin(angle), z], axis=1)
    surfels = check(map_of(pole), pole)
    assert surfels.size.max() <= 0.25
    corner = np.concatenate([sheet((0, 0), (0.5, 0.5), axis, 0.06) for axis in range(3)])
    surfels = check(map_of(corner), corner)
    axes = np.min([angles_deg(surfels, axis) for axis in np.eye(3)], axis=0)
    assert axes[surfels.size > BASE_M].max(initial=0.0) < 1.0


def test_gentle_bend_is_followed_by_smaller_cells():
    """A cylinder of radius 5 m: a cell of 2 m would be off by 11 deg at its border, 1 m by 6."""
    points = sheet((-2, -2), (2, 2), 2, 0.0)
    points[:, 2] += 5.0 - np.sqrt(25.0 - points[:, 0] ** 2)
    surfels = check(map_of(points), points)
    rows = members(surfels, points[::50])
    true = np.stack([-points[::50, 0], 0 * points[::50, 0], 5.0 - points[::50, 2]], axis=1)
    dots = np.abs(np.sum(surfels.normal[rows] * true, axis=1) / np.linalg.norm(true, axis=1))
    error = np.degrees(np.arccos(np.minimum(dots, 1.0)))
    assert np.quantile(error[surfels.size[rows] > BASE_M], 0.99) < 6.0
    assert surfels.size.max() <= 1.0


def test_box_on_a_floor_survives():
    floor, top = sheet((0, 0), (2, 2), 2, 0.06), sheet((1.0, 1.0), (1.2, 1.2), 2, 0.31)
    points = np.concatenate([floor, top])
    surfels = check(map_of(points), points)
    rows = np.unique(members(surfels, top[::5]))
    assert np.abs(surfels.position[rows, 2] - 0.31).max() < 0.01
    assert surfels.size[rows].max() <= 0.25


def test_rings_on_far_ground_stay_voxels_until_they_are_two():
    """A ring of 2 m length in a row of voxels is a line: no plane."""
    rng = np.random.default_rng(1)
    ring = np.stack([rng.uniform(0, 2, 400), np.full(400, 0.06), np.full(400, 0.06)], axis=1)
    ring[:, 1:] += rng.normal(scale=NOISE_M, size=(400, 2))
    assert (check(map_of(ring), ring).size == BASE_M).all()
    second = ring + np.array([0, 1.3, 0])
    surfels = check(map_of(ring, second), np.concatenate([ring, second]))
    assert surfels.size.tolist() == [2.0]


def test_cell_of_one_child_reports_the_radius_of_its_points():
    patch = sheet((0.01, 0.01), (0.12, 0.12), 2, 0.06)
    (surfel,) = check(map_of(patch), patch)
    assert surfel.size == BASE_M
    assert surfel.radius < BASE_M


def test_empty_and_single_points():
    assert len(SurfelMap(0.2).adaptive()) == 0
    lone = map_of(np.array([[0.1, 0.1, 0.1]]))
    assert lone.adaptive().num_points.tolist() == [1]
    assert len(lone.adaptive(2)) == 0


@pytest.mark.parametrize(
    ('settings', 'error', 'message'),
    [
        ({'levels': 0}, ValueError, 'levels: 0, expected 1 to 6'),
        ({'levels': 7}, ValueError, 'levels: 7, expected 1 to 6'),
        ({'levels': 1.5}, TypeError, 'levels'),
        ({'max_thickness_m': 0.0}, ValueError, 'max_thickness_m: 0.0, expected positive'),
        ({'max_thickness_m': float('nan')}, ValueError, 'max_thickness_m: nan'),
        ({'min_points': 'two'}, TypeError, 'min_points'),
    ],
)
def test_bad_settings_are_refused(settings, error, message):
    with pytest.raises(error, match=message):
        SurfelMap(0.2).adaptive(**settings)


def test_channels_and_scans_of_a_cell_are_those_of_its_voxels():
    floor = sheet((0, 0), (2, 2), 2, 0.06)
    surfel_map = SurfelMap(BASE_M, columns=('intensity',))
    for value in (1.0, 3.0):
        surfel_map.add(floor, columns={'intensity': np.full(len(floor), value)})
    (surfel,) = surfel_map.adaptive()
    assert surfel.num_scans == 2
    assert surfel_map.adaptive().channels['intensity'].tolist() == [2.0]


def test_too_many_points_for_the_integers_leave_smaller_cells():
    """2^23 points fit a cell of 16 voxels; one more and its half takes over."""
    corners = [(x, y, 0) for x in (-20000, 20000) for y in (-20000, 20000)]
    voxels = [(i, j, 0) for i in range(16) for j in range(16)]
    for per_voxel, sizes in ((2**15, [8.0]), (2**15 + 4, [4.0] * 4)):
        surfel_map = SurfelMap(0.5)
        moments = made_up(voxels, [per_voxel] * 256, corners)
        surfel_map.insert(moments)
        assert surfel_map.adaptive(max_thickness_m=0.1).size.tolist() == sizes


class Program:
    """Random adds, removes and clears of scans of flat patches, in a map with an adaptive cut."""

    def __init__(self, seed, **settings):
        self.rng = np.random.default_rng(seed)
        self.settings = settings
        self.map = SurfelMap(0.25)
        self.cut = AdaptiveCut(self.map, **settings)
        self.live, self.rows = [], {}

    def scan(self):
        rng = self.rng
        num = rng.integers(1, 120)
        points = rng.uniform(-2.0, 2.0, (num, 3)) * [1.0, 1.0, 0.02]
        points[:, 2] += rng.choice([0.1, 0.11, -0.4, 1.0])
        return points[:, rng.permutation(3)] if rng.random() < 0.3 else points

    def step(self):
        choice = self.rng.random()
        if choice < 0.55 or not self.live:
            self.live.append(self.map.add(self.scan(), self.rng.normal(size=3)))
        elif choice < 0.97:
            self.map.remove(self.live.pop(self.rng.integers(len(self.live))))
        else:
            self.map.clear()
            self.live.clear()

    def refresh(self):
        """Follow the map; apply the change to a copy of the cut."""
        change = self.cut.refresh()
        removed = zip(change.removed_size, map(tuple, change.removed_index), strict=True)
        for key in [(size, *index) for size, index in removed]:
            del self.rows[key]
        columns = np.column_stack(change.surfels.arrays)
        for key, row in zip(keys_of(change.surfels), columns, strict=True):
            self.rows[key] = row

    def check(self):
        fresh = AdaptiveCut(self.map, **self.settings)
        surfels = fresh.refresh().surfels
        assert self.cut.digest() == fresh.digest()
        expected = dict(zip(keys_of(surfels), np.column_stack(surfels.arrays), strict=True))
        assert self.rows.keys() == expected.keys()
        for key, row in expected.items():
            np.testing.assert_array_equal(self.rows[key], row)


def keys_of(surfels):
    index = surfels.voxel_index.tolist()
    return [(s, *i) for s, i in zip(surfels.size.tolist(), index, strict=True)]


@pytest.mark.parametrize('batch', range(10))
def test_cut_after_random_programs_is_that_of_a_new_map(batch):
    """100 programs a batch: changes add up to the cut, its digest is that of the live scans."""
    for seed in range(100 * batch, 100 * batch + 100):
        program = Program(seed, min_points=1 + seed % 3, levels=1 + seed % 4)
        for _ in range(program.rng.integers(2, 12)):
            for _ in range(program.rng.integers(1, 4)):
                program.step()
            program.refresh()
        program.check()
        shuffled = SurfelMap(0.25)
        for moments in program.rng.permutation(np.array(program.live, object)):
            shuffled.insert(moments)
        other = AdaptiveCut(shuffled, **program.settings)
        other.refresh()
        assert program.cut.digest() == other.digest()


@pytest.mark.parametrize('seed', range(12))
def test_cut_of_random_maps_is_that_of_the_twin(seed):
    program = Program(1000 + seed)
    for _ in range(15):
        program.step()
    surfels = program.map.adaptive(levels=3)
    level = np.log2(surfels.size / 0.25).astype(int).tolist()
    cut = zip(level, map(tuple, surfels.voxel_index.tolist()), surfels.num_points, strict=True)
    assert set(cut) == twin_cut(program.map, levels=3)


def test_unchanged_map_has_no_change():
    surfel_map = map_of(sheet((0, 0), (2, 2), 2, 0.06))
    cut = AdaptiveCut(surfel_map)
    assert len(cut.refresh().surfels) == 1
    change = cut.refresh()
    assert len(change.surfels) == len(change.removed_size) == 0


def test_cut_behind_its_map_is_refused():
    cut = (surfel_map := SurfelMap(0.25)).adaptive_cut()
    surfel_map.add(np.zeros((1, 3)))
    for stale in (cut.surfels, cut.digest):
        with pytest.raises(MapError, match='call refresh first'):
            stale()


def test_change_is_reported_below_changed_roots_only():
    surfel_map = map_of(sheet((0, 0), (6, 2), 2, 0.06))
    cut = AdaptiveCut(surfel_map)
    assert len(cut.refresh().surfels) == 3
    moments = surfel_map.add(sheet((4.5, 1.0), (4.6, 1.1), 2, 0.9))
    change = cut.refresh()
    assert change.removed_index.tolist() == [[2, 0, 0]]
    assert change.removed_size.tolist() == [2.0]
    assert (change.surfels.position[:, 0] > 4.0).all()
    surfel_map.remove(moments)
    change = cut.refresh()
    assert change.surfels.size.tolist() == [2.0]
    assert len(cut.surfels()) == 3


def test_change_after_a_failure_is_whole(monkeypatch):
    surfel_map = map_of(sheet((0, 0), (4, 2), 2, 0.06))
    cut = AdaptiveCut(surfel_map)
    cut.refresh()
    surfel_map.clear()
    surfel_map.add(sheet((0, 0), (2, 2), 2, 0.06))
    monkeypatch.setattr(AdaptiveCut, '_compare', None)
    with pytest.raises(TypeError):
        cut.refresh()
    monkeypatch.undo()
    change = cut.refresh()
    assert change.surfels.voxel_index.tolist() == [[0, 0, 0]]
    assert change.removed_index.tolist() == [[1, 0, 0]]


def test_emptied_cells_are_freed():
    surfel_map = SurfelMap(0.25)
    cut = AdaptiveCut(surfel_map)
    sizes = []
    for step in range(30):
        moments = surfel_map.add(sheet((4.0 * step, 0), (4.0 * step + 2, 2), 2, 0.06, 0.05))
        cut.refresh()
        surfel_map.remove(moments)
        cut.refresh()
        sizes.append(cut.nbytes)
    assert sizes[-1] == sizes[2]
