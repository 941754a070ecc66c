# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of maps that are off by known amounts are these amounts."""

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.evaluation.comparison import CloudTruth, completeness, evaluate, spread
from surfel_mapper.evaluation.map_files import Discs
from surfel_mapper.evaluation.mesh_truth import load_mesh, MeshTruth
from surfel_mapper.evaluation.truth import WorldTruth
from surfel_mapper.simulation import Lidar, Primitive, Simulation, World
from surfel_mapper.tsdf.mesh import Mesh

SIDE = 40


def grid(height_m=0.0, tilt_deg=0.0, side=SIDE, shift_m=0.0):
    """Return discs half a metre apart in a plane, whose normals are tilted about x."""
    x, y = (axis.ravel() * 0.5 + shift_m for axis in np.meshgrid(*[np.arange(side)] * 2))
    tilt = np.deg2rad(tilt_deg)
    normal = np.tile([0.0, np.sin(tilt), np.cos(tilt)], (side * side, 1))
    return Discs(np.column_stack([x, y, np.full(x.size, height_m)]), normal)


def compared(surfels, truth, **limits):
    return evaluate(surfels, truth, **{'max_distance_m': 0.5, 'radius_m': 0.5, **limits})


def test_a_map_equal_to_the_truth_has_no_errors():
    result = compared(grid(), CloudTruth(grid()))
    assert result['surfels'] == result['compared'] == result['normals_compared'] == SIDE**2
    assert result['position_m'] == dict.fromkeys(('mean', 'median', 'p95', 'max'), 0.0)
    assert result['normal_deg']['max'] < 1e-6
    assert result['completeness'] == 1.0
    assert result['normals_on_the_other_side'] == 0


def test_height_and_tilt_come_back_as_they_are():
    result = compared(grid(height_m=0.03, tilt_deg=7.0, shift_m=0.1), CloudTruth(grid()))
    # along the normal of the truth alone: the shift within the plane is no error
    assert result['position_m']['mean'] == pytest.approx(0.03)
    assert result['position_m']['p95'] == pytest.approx(0.03)
    assert result['normal_deg']['mean'] == pytest.approx(7.0)


def test_normals_on_the_other_side_are_counted_and_their_axes_compared():
    upside_down = grid(tilt_deg=3.0)
    upside_down.normal[:100] *= -1.0
    result = compared(upside_down, CloudTruth(grid()))
    assert result['normals_on_the_other_side'] == 100
    assert result['normal_deg']['max'] == pytest.approx(3.0)


def test_without_normals_of_the_truth_distances_to_points_count():
    truth = CloudTruth(Discs(grid().position, None))
    result = compared(grid(height_m=0.3, shift_m=0.1), truth)
    assert result['position_m']['mean'] == pytest.approx(np.sqrt(0.3**2 + 2 * 0.1**2), rel=0.01)
    assert 'normal_deg' not in result


def test_surfels_far_from_the_truth_are_not_compared():
    far = grid()
    far.position[:7, 2] += 3.0
    result = compared(far, CloudTruth(grid()))
    assert result['compared'] == SIDE**2 - 7
    assert result['position_m']['max'] == 0.0


def test_surfels_without_a_normal_are_compared_by_position_alone():
    odd = grid(tilt_deg=2.0)
    odd.normal[:5] = np.nan
    result = compared(odd, CloudTruth(grid()))
    assert result['compared'] == SIDE**2
    assert result['normals_compared'] == SIDE**2 - 5
    assert result['normal_deg']['max'] == pytest.approx(2.0)


def test_half_a_map_is_half_complete_however_dense_a_part_of_the_truth_is():
    half = grid(side=SIDE)
    half = Discs(half.position[half.position[:, 0] < 10.0 - 1e-9], None)
    dense = np.repeat(grid().position[:50], 100, axis=0)
    samples = np.concatenate([grid().position, dense])
    assert completeness(half.position, samples, 0.4) == pytest.approx(0.5)


def test_an_empty_map_has_no_errors_and_no_completeness():
    nothing = Discs(np.empty((0, 3)), np.empty((0, 3)))
    result = compared(nothing, CloudTruth(grid()))
    assert result['compared'] == 0
    assert result['position_m']['mean'] is None
    assert result['completeness'] == 0.0
    assert compared(grid(), CloudTruth(nothing))['compared'] == 0
    assert compared(grid(), CloudTruth(nothing))['completeness'] is None


def test_mean_and_percentile_are_of_the_errors_given():
    assert spread(np.arange(101.0)) == {'mean': 50.0, 'median': 50.0, 'p95': 95.0, 'max': 100.0}


@pytest.fixture(scope='module')
def ground():
    """Return a world of a single ground, seen by a lidar 2 m above it."""
    world = World([Primitive(kind='rectangle', size_m=(60.0, 60.0), xyz=(15.0, 0.0, 0.0))])
    lidar = Lidar(beams=16, columns=256, range_noise_m=0.5)
    return world, Simulation(world, lidar, num_scans=5)


def test_a_world_is_the_truth_of_positions_and_normals(ground):
    world, _ = ground
    result = compared(grid(height_m=-0.02, tilt_deg=5.0), WorldTruth(world))
    assert result['position_m']['mean'] == pytest.approx(0.02)
    assert result['normal_deg']['mean'] == pytest.approx(5.0)
    assert 'completeness' not in result  # a world alone has no samples


def test_complete_is_a_map_of_what_the_drive_saw_without_its_noise(ground):
    truth = WorldTruth(*ground)
    samples = truth.samples()

    assert len(samples) > 1000
    np.testing.assert_allclose(samples[:, 2], 0.0, atol=1e-5)  # the noise is half a metre
    assert compared(Discs(samples, None), truth)['completeness'] == 1.0
    ahead = samples[:, 0] > np.median(samples[:, 0])
    assert 0.2 < compared(Discs(samples[ahead], None), truth)['completeness'] < 0.8


SIZE_M = np.array([12.0, 8.0, 3.0])


def off_the_walls(number=2000):
    """Return positions 2 cm inside of the walls of a room, and the walls' inward normals."""
    rng = np.random.default_rng(3)
    position = rng.uniform(-0.5, 0.5, (number, 3)) * (SIZE_M - 0.1)
    axis, side = rng.integers(0, 3, number), rng.choice([-1.0, 1.0], number)
    rows = np.arange(number)
    position[rows, axis] = side * (0.5 * SIZE_M[axis] - 0.02)
    normal = np.zeros((number, 3))
    normal[rows, axis] = -side
    return Discs(position, normal)


def box(trimesh, path):
    """Write a box of twelve triangles."""
    trimesh.creation.box(SIZE_M).export(path)
    return path


@pytest.mark.parametrize('suffix', ['ply', 'obj', 'stl', 'glb'])
def test_a_mesh_is_compared_with_its_faces(tmp_path, suffix):
    trimesh = pytest.importorskip('trimesh', reason='trimesh is not installed (extra meshes)')
    if suffix == 'glb':  # y is up
        trimesh.creation.box(SIZE_M[[0, 2, 1]]).export(tmp_path / 'box.glb')
    path = tmp_path / 'box.glb' if suffix == 'glb' else box(trimesh, tmp_path / f'box.{suffix}')

    result = compared(off_the_walls(), load_mesh(path), radius_m=1.0)

    assert result['compared'] == 2000
    assert result['position_m']['mean'] == pytest.approx(0.02, abs=1e-6)
    assert result['position_m']['max'] == pytest.approx(0.02, abs=1e-6)
    assert result['normal_deg']['max'] < 1e-4
    assert result['completeness'] > 0.97


def test_places_of_a_mesh_are_those_of_every_triangle_alone():
    trimesh = pytest.importorskip('trimesh', reason='trimesh is not installed (extra meshes)')
    rng = np.random.default_rng(4)
    vertices = rng.uniform(-2.0, 2.0, (60, 3))
    triangles = rng.integers(0, 60, (40, 3)).astype(np.int32)
    mesh = Mesh(vertices=vertices, triangles=triangles, colors=np.empty((0, 3), np.uint8))
    asked = rng.uniform(-2.5, 2.5, (200, 3))

    nearest = MeshTruth(mesh).nearest(asked)

    alone = [
        trimesh.triangles.closest_point(np.tile(corners, (200, 1, 1)), asked)
        for corners in vertices[mesh.triangles]
        if np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])) > 0.0
    ]
    distance_m = np.linalg.norm(np.array(alone) - asked, axis=2).min(axis=0)
    np.testing.assert_allclose(nearest.distance_m, distance_m, atol=2e-3)


def test_points_are_no_mesh(tmp_path):
    trimesh = pytest.importorskip('trimesh', reason='trimesh is not installed (extra meshes)')
    for name in ('a.ply', 'a.obj'):
        trimesh.PointCloud(np.eye(3)).export(tmp_path / name)
        assert load_mesh(tmp_path / name) is None
    assert load_mesh(tmp_path / 'map.npz') is None
    (tmp_path / 'a.stl').write_bytes(bytes(90))
    with pytest.raises(FileFormatError, match=r'a\.stl'):
        load_mesh(tmp_path / 'a.stl')
