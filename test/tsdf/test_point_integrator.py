# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Points fused ray by ray: against a twin, against known surfaces, and for any sensor."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import CloudFormatError, MapLimitError, PoseError
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.mesh import Mesher
from surfel_mapper.tsdf.point_integrator import PointIntegrator
from surfel_mapper.tsdf.queries import labels_at, sample
from test.tsdf.scenes import lidar_rays

VOXEL_M = 0.2
POSE = pose_matrix([0.33, -0.71, 0.52], [0.1, -0.2, 0.3, np.sqrt(0.86)])
DISC = 0.85


def integrator(**settings):
    return PointIntegrator(
        BlockMap(TsdfConfig(**{'voxel_size_m': VOXEL_M, 'max_range_m': 20.0, **settings}))
    )


def fused(points, pose=POSE, **settings):
    one = integrator(**settings)
    one.integrate(points, pose, 5)
    return one.blocks


def mesh_of(blocks):
    mesher = Mesher(blocks)
    mesher.update()
    return mesher.mesh()


def voxels_of(blocks):
    """Return distance and weight of each observed voxel by its index."""
    side, voxels = blocks.config.voxels_per_side, {}
    for row, block in zip(blocks.rows(), blocks.index(blocks.rows()), strict=True):
        for n in np.flatnonzero(blocks.weight[row]):
            index = block * side + np.array([n % side, n // side % side, n // side**2])
            voxels[tuple(index.tolist())] = blocks.distance[row, n], blocks.weight[row, n]
    return voxels


def crossed(origin, ahead, start, end):
    """Return the voxels on a ray between two ranges, from its crossings of the grid planes."""
    cuts = [start, end]
    for axis in range(3):
        low, high = sorted((origin[axis] + start * ahead[axis], origin[axis] + end * ahead[axis]))
        planes = np.arange(np.ceil(low), np.floor(high) + 1)
        cuts += ((planes - origin[axis]) / ahead[axis]).tolist()
    cuts = np.sort(np.clip(cuts, start, end))
    middles = 0.5 * (cuts[1:] + cuts[:-1])[np.diff(cuts) > 1e-9]
    return np.floor(origin + middles[:, None] * ahead).astype(int)


def twin(points, pose, carve_m):
    """Return distance and weight of each voxel after one scan of points too sparse for planes."""
    config = TsdfConfig(voxel_size_m=VOXEL_M)
    tau, origin = config.tau_m / VOXEL_M, pose[:3, 3] / VOXEL_M
    near, far = 0.5 / VOXEL_M, 20.0 / VOXEL_M
    sums, free = {}, set()
    for point in points @ pose[:3, :3].T / VOXEL_M:
        measured = np.linalg.norm(point)
        ahead, behind = point / measured, np.abs(point / measured).sum()
        if near <= measured <= far:
            full = 0.3 / (measured * VOXEL_M) ** 2
            middle = np.floor(origin + point).astype(int)
            for offset in np.ndindex(11, 11, 11):
                voxel = middle + offset - 5
                apart = voxel + 0.5 - origin - point
                signed = -ahead @ apart
                aside = apart @ apart - signed**2
                if aside <= DISC**2 and -behind <= signed <= tau:
                    share = max(1.0 - signed / (tau if signed > 0.0 else -behind), 0.02)
                    weight = full * share * (1.0 - 0.8 * aside / DISC**2)
                    sums.setdefault(tuple(voxel.tolist()), []).append((weight, signed))
        end = min(measured - tau if measured <= far else measured, carve_m / VOXEL_M)
        if measured > far:
            end -= tau
        if near < measured and end > near:
            free |= set(map(tuple, crossed(origin, ahead, near, end).tolist()))
    voxels = dict.fromkeys(free, (config.tau_m, 1e-4))
    for voxel, values in sums.items():
        weights, distances = np.transpose(values)
        voxels[voxel] = np.average(distances, weights=weights) * VOXEL_M, weights.sum()
    return voxels


@pytest.mark.parametrize(('side', 'carve_m'), [(2, 20.0), (8, 20.0), (8, 0.0), (8, 5.0)])
def test_voxels_equal_those_of_the_twin(side, carve_m):
    rng = np.random.default_rng(1)
    # rays apart from each other: free rays end where an earlier one has freed the way
    points = rng.normal(size=(12, 3)) * 4.0
    points[0] *= 0.01
    points[1] *= 30.0 / np.linalg.norm(points[1])

    voxels = voxels_of(fused(points, voxels_per_side=side, carve_m=carve_m))

    expected = twin(points, POSE, carve_m)
    missing = expected.keys() - voxels.keys()
    # beside the sensor, where rays join, a ray may end in voxels that others have freed
    near = {v for v in missing if np.linalg.norm(np.add(v, 0.5) * VOXEL_M - POSE[:3, 3]) < 2.0}
    assert missing == near
    assert voxels.keys() <= expected.keys()
    for voxel, (distance, weight) in voxels.items():
        assert distance == pytest.approx(expected[voxel][0], abs=1e-4)
        assert weight == pytest.approx(max(expected[voxel][1], 1e-4), rel=1e-3)


def plane_points(angle_deg, number, noise_m=0.0, half_m=2.5):
    """Return points of a plane 4 m ahead along x, turned about y by an angle; and its normal."""
    rng, angle = np.random.default_rng(number), np.deg2rad(angle_deg)
    u, v = rng.uniform(-half_m, half_m, (2, number))
    normal = np.array([np.cos(angle), 0.0, np.sin(angle)])
    points = np.array([4.0, 0.0, 0.0]) + np.outer(u, [0.0, 1.0, 0.0])
    points += np.outer(v, [-np.sin(angle), 0.0, np.cos(angle)])
    ranges = np.linalg.norm(points, axis=1, keepdims=True)
    return points * (1.0 + noise_m * rng.standard_normal((number, 1)) / ranges), normal


@pytest.mark.parametrize('angle_deg', [0.0, 30.0, 60.0, 75.0])
def test_distances_are_those_to_the_plane_at_any_angle_of_incidence(angle_deg):
    points, normal = plane_points(angle_deg, 20_000)
    blocks = fused(points, np.eye(4), carve_m=0.0)
    voxels = voxels_of(blocks)
    centres = (np.array(list(voxels)) + 0.5) * VOXEL_M
    truth = -(centres - [4.0, 0.0, 0.0]) @ normal
    inside = np.abs(centres @ [-normal[2], 0.0, normal[0]] - 4.0 * -normal[2]) < 1.5
    inside &= np.abs(centres[:, 1]) < 1.5
    error = np.abs(np.array([distance for distance, _ in voxels.values()]) - truth)[inside]
    assert inside.sum() > 500
    assert error.max() < 1e-3


def test_noise_of_a_plane_is_averaged():
    points, normal = plane_points(20.0, 20_000, noise_m=0.02)
    vertices = mesh_of(fused(points, np.eye(4), carve_m=0.0)).vertices
    vertices = vertices[np.abs(vertices[:, 1:]).max(axis=1) < 1.5]
    error = (vertices - [4.0, 0.0, 0.0]) @ normal
    # a voxel has 32 points on average: 0.02 / 32^(1/2) is 3.5 mm; more where noise divides them
    assert np.sqrt(np.mean(error**2)) < 0.00501


def test_ground_between_the_rings_of_a_lidar_is_smooth():
    one, rng = integrator(voxel_size_m=0.1, carve_m=0.0), np.random.default_rng(1)
    rays = lidar_rays(64, 1024, 60.0).reshape(-1, 3).astype(float)
    rays = rays[rays[:, 2] < -0.15]
    for number in range(4):
        T = np.eye(4)
        T[0, 3] = 0.37 * number
        ranges = -1.55 / rays[:, 2] + 0.02 * rng.standard_normal(len(rays))
        one.integrate(rays * ranges[:, None], T, number * 10**8)
    mesh = mesh_of(one.blocks)
    corners = mesh.vertices[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas, apart = np.linalg.norm(normals, axis=1), np.hypot(*corners[:, :, :2].mean(axis=1).T)
    ring = (areas > 1e-9) & (apart > 4.0) & (apart < 8.0)
    tilts_deg = np.degrees(np.arccos(np.clip(normals[ring, 2] / areas[ring], -1.0, 1.0)))
    assert ring.sum() > 20_000
    # with planes of 9 voxels, for larger voxels, these are 3.0 deg and 3.2 mm
    assert np.average(tilts_deg, weights=areas[ring]) < 2.7
    assert np.sqrt(np.mean((corners[ring, :, 2] + 1.55) ** 2)) < 0.0027


def wall_of(thickness_m, tilt=0.0, num_scans=6):
    """Return errors, m, of the mesh of a wall that was seen from both sides in turn."""
    one, rng = integrator(voxel_size_m=0.1), np.random.default_rng(0)
    turn = Rotation.from_euler('zy', [tilt, tilt]).as_matrix()
    for number in range(num_scans):
        side = 1.0 if number % 2 else -1.0
        origin = np.array([4.0 * side, 0.3 * number, 0.1])
        points = np.column_stack([np.full(20_000, 0.5 * side), rng.uniform(-2, 2, (20_000, 2))])
        points[:, 0] *= thickness_m
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn, turn @ origin + 0.033
        one.integrate(points - origin, T, number * 10**8)
    vertices = (mesh_of(one.blocks).vertices - 0.033) @ turn
    inner = vertices[np.abs(vertices[:, 1:]).max(axis=1) < 1.7]
    assert (inner[:, 0] > 0.0).sum() > 500
    assert (inner[:, 0] < 0.0).sum() > 500
    return np.abs(np.abs(inner[:, 0]) - 0.5 * thickness_m)


@pytest.mark.parametrize('tilt', [0.0, 0.3])
def test_both_faces_of_a_wall_of_two_voxels_are_exact(tilt, caplog):
    error = wall_of(0.2, tilt)
    assert np.median(error) < 1e-3
    assert np.quantile(error, 0.95) < 3e-3
    assert not caplog.records


def test_both_faces_of_a_wall_of_one_voxel_are_within_an_eighth_of_it():
    assert np.quantile(wall_of(0.1), 0.95) < 0.0125


def test_surfaces_closer_than_two_voxels_are_warned_of_once(caplog):
    one, points = integrator(), plane_points(0.0, 20_000)[0]
    back = np.diag([-1.0, -1.0, 1.0, 1.0])
    back[0, 3] = 8.02
    for number in range(4):
        one.integrate(points, back if number % 2 else np.eye(4), number * 10**8)
    assert [record.message.split(':')[0] for record in caplog.records] == [
        'layers.tsdf.voxel_size_m'
    ]


def test_a_ray_that_passes_a_surface_leaves_its_distances():
    ground, _ = plane_points(90.0, 20_000)
    ground = np.random.default_rng(1).uniform(-4.0, 4.0, (40_000, 3)) * [1.0, 1.0, 0.0]
    one, T = integrator(), np.eye(4)
    T[2, 3] = 1.0
    one.integrate(ground - T[:3, 3], T, 0)
    expected = voxels_of(one.blocks)
    low = np.eye(4)
    low[:3, 3] = (-3.9, 0.0, 0.15)
    azimuth = np.linspace(-0.3, 0.3, 200)
    level = 15.0 * np.stack([np.cos(azimuth), np.sin(azimuth), 0.0 * azimuth], axis=1)
    one.integrate(level, low, 10**8)
    voxels = voxels_of(one.blocks)
    assert all(voxels[index][0] == distance for index, (distance, _) in expected.items())


def test_the_result_does_not_depend_on_the_number_of_threads():
    states = []
    for threads in (1, 2, 8):
        one = integrator(threads=threads)
        points, _ = plane_points(40.0, 5000, noise_m=0.02)
        results = [one.integrate(points, POSE, stamp) for stamp in (5, 9)]
        content = one.blocks.copied(one.blocks.rows())
        states.append((results, content.index.tobytes(), content.field.tobytes()))
    assert states[0] == states[1] == states[2]


def test_rays_beside_a_thin_pole_do_not_erase_it():
    azimuth, up = np.meshgrid(np.deg2rad(np.arange(-20.0, 20.0, 0.2)), np.arange(-1.0, 1.0, 0.1))
    pole = np.abs(azimuth) < np.deg2rad(0.3)
    distance = np.where(pole, 5.0, 9.0)
    points = np.stack(
        [distance * np.cos(azimuth), distance * np.sin(azimuth), up * distance / 5.0], axis=-1
    )
    one = integrator()
    for number in range(5):
        one.integrate(points.reshape(-1, 3), np.eye(4), number * 10**8)
    nearest, _ = cKDTree(mesh_of(one.blocks).vertices).query(points[pole])
    assert (nearest < VOXEL_M).mean() > 0.95


def test_a_scan_beyond_the_limit_is_right_within_the_radius_that_fits():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(4000, 3))
    points *= rng.uniform(1.0, 49.0, (4000, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    whole, limited = (
        integrator(voxel_size_m=0.1, max_range_m=50.0),
        integrator(voxel_size_m=0.1, max_range_m=50.0),
    )
    whole.integrate(points, np.eye(4))
    limited.blocks.max_bytes = 40 << 20
    limited.integrate(points, np.eye(4))
    assert limited.blocks.nbytes <= 41 << 20 < whole.blocks.nbytes
    rows, copies = (
        whole.blocks.rows(),
        limited.blocks.find(whole.blocks.index(whole.blocks.rows())),
    )
    apart_m = np.linalg.norm((whole.blocks.index(rows) + 0.5) * 0.8, axis=1)
    inner = apart_m < apart_m[copies < 0].min()
    assert inner.sum() > 5000
    np.testing.assert_array_equal(
        limited.blocks.field[copies[inner]], whole.blocks.field[rows[inner]]
    )


@pytest.mark.parametrize(
    ('settings', 'spread_m', 'max_bytes', 'cause'),
    [
        ({'carve_m': 50.0}, 45.0, 3 << 20, 'a scan that touches .* blocks'),
        ({'carve_m': 0.0, 'truncation_m': 8.0}, 1.0, 150_000, 'pairs of blocks and cells'),
    ],
    ids=['free space', 'surfaces'],
)
def test_a_scan_is_charged_for_its_working_memory(settings, spread_m, max_bytes, cause):
    one = integrator(max_range_m=60.0, voxel_size_m=0.05, **settings)
    one.blocks.max_bytes = max_bytes
    points = np.random.default_rng(4).uniform(-spread_m, spread_m, (2000, 3))
    points[:, 0] = 30.0
    with pytest.raises(MapLimitError, match=rf'{cause}: .*working memory.*map\.max_bytes'):
        one.integrate(points, np.eye(4))
    assert one.blocks.num_blocks == one.blocks.version == 0
    assert one.integrate(points[:20], np.eye(4)).num_updated > 0


def test_points_that_are_no_measurements_change_nothing():
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0], [0.1, 0.1, 0.0]])
    blocks = fused(points)
    assert blocks.num_blocks == 0
    assert fused(np.empty((0, 3))).num_blocks == 0


def test_colours_and_labels_are_kept():
    blocks = BlockMap(
        TsdfConfig(
            voxel_size_m=VOXEL_M,
            color=True,
            semantics='single',
            dynamic_labels=(9.0,),
        )
    )
    points = np.array([[5.0, 0.0, 0.0], [5.0, 3.0, 0.0], [5.0, -3.0, 0.0]])
    colors = np.array([[200, 100, 50, 255], [1, 2, 3, 0], [9, 9, 9, 255]], np.uint8)
    integrator = PointIntegrator(blocks)
    integrator.integrate(
        points, np.eye(4), 7, colors=colors, labels=np.array([4, -1, 9], np.int32)
    )
    label, weight = labels_at(blocks, points)
    assert label.tolist() == [4, -1, -1]
    assert weight[0] > 0.0
    rows = blocks.rows()
    kept = blocks.color[rows][:, 3] > 0.0
    np.testing.assert_allclose(
        blocks.color[rows].transpose(0, 2, 1)[kept][:, :3], np.tile([200, 100, 50], (8, 1))
    )
    # the moving point frees the way and leaves no surface
    assert np.isnan(sample(blocks, points[2:]).distance).all()


def test_bad_input_is_refused_and_the_map_unchanged():
    blocks = BlockMap(TsdfConfig(voxel_size_m=VOXEL_M))
    integrator, points = PointIntegrator(blocks), np.ones((2, 3))
    with pytest.raises(PoseError):
        integrator.integrate(points, np.zeros((4, 4)))
    with pytest.raises(CloudFormatError, match='labels: 3, expected 2'):
        integrator.integrate(points, np.eye(4), labels=np.zeros(3, int))
    far = np.eye(4)
    far[0, 3] = 9e8
    with pytest.raises(MapLimitError):
        integrator.integrate(points, far)
    assert blocks.num_blocks == 0
