# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Points fused ray by ray: against a twin, against known surfaces, and for any sensor."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import CloudFormatError, MapLimitError, PoseError
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.mesh import Mesher
from surfel_mapper.tsdf.point_integrator import PointIntegrator
from surfel_mapper.tsdf.queries import labels_at, sample

VOXEL_M, TAU_M = 0.2, 0.6
POSE = pose_matrix([0.33, -0.71, 0.52], [0.1, -0.2, 0.3, np.sqrt(0.86)])


def fused(points, pose=POSE, **settings):
    config = TsdfConfig(
        **{
            'voxel_size_m': VOXEL_M,
            'truncation_m': TAU_M,
            'weight_mode': 'constant',
            'max_range_m': 20.0,
            **settings,
        }
    )
    blocks = BlockMap(config)
    PointIntegrator(blocks).integrate(points, pose, 5)
    return blocks


def voxels_of(blocks):
    """Return distance and weight of each observed voxel by its index."""
    side, found = blocks.config.voxels_per_side, {}
    for row, block in zip(blocks.rows(), blocks.index(blocks.rows()), strict=True):
        for n in np.flatnonzero(blocks.weight[row]):
            place = block * side + np.array([n % side, n // side % side, n // side**2])
            found[tuple(place.tolist())] = blocks.distance[row, n], blocks.weight[row, n]
    return found


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


def twin(points, pose):
    """Return distance and weight of each voxel after one scan."""
    origin, near, far = pose[:3, 3] / VOXEL_M, 0.5 / VOXEL_M, 20.0 / VOXEL_M
    tau, seen, free = TAU_M / VOXEL_M, {}, set()
    for point in points @ pose[:3, :3].T / VOXEL_M:
        measured = np.linalg.norm(point)
        ahead = point / measured
        if near <= measured <= far:
            for voxel in crossed(origin, ahead, max(measured - tau, near), measured + tau):
                signed = measured - ahead @ (voxel + 0.5 - origin)
                if abs(signed) > 1.0 and signed >= -tau:
                    seen.setdefault(tuple(voxel), []).append(np.clip(signed, -tau, tau))
            cells = [
                tuple(np.floor(origin + (measured + t) * ahead - 0.5).astype(int))
                for t in (-1.0, -0.5, 0.0, 0.5, 1.0)
            ]
            for cell in dict.fromkeys(cells):
                for corner in np.ndindex(2, 2, 2):
                    voxel = np.add(cell, corner)
                    signed = measured - ahead @ (voxel + 0.5 - origin)
                    seen.setdefault(tuple(voxel.tolist()), []).append(signed)
        if near < measured and min(measured - tau, far) > near:
            free |= set(map(tuple, crossed(origin, ahead, near, min(measured - tau, far))))
    found = {}
    for voxel, values in seen.items():
        weights = np.clip((tau + np.array(values)) / (tau - 1.0), 1e-4, 1.0)
        found[voxel] = np.average(values, weights=weights) * VOXEL_M, weights.mean()
    return dict.fromkeys(free, (TAU_M, 1.0)) | found


@pytest.mark.parametrize('side', [2, 8])
def test_voxels_equal_those_of_the_twin(side):
    rng = np.random.default_rng(1)
    # rays apart from each other: free rays end where an earlier one has freed the way
    points = rng.normal(size=(12, 3)) * 4.0
    points[0] *= 0.01
    points[1] *= 30.0 / np.linalg.norm(points[1])

    found = voxels_of(fused(points, voxels_per_side=side))

    expected = twin(points, POSE)
    missing = expected.keys() - found.keys()
    # beside the sensor, where rays join, a ray may end in voxels that others have freed
    near = {v for v in missing if np.linalg.norm(np.add(v, 0.5) * VOXEL_M - POSE[:3, 3]) < 2.0}
    assert missing == near
    assert found.keys() <= expected.keys()
    for voxel, (distance, weight) in found.items():
        assert (distance, weight) == pytest.approx(expected[voxel], abs=1e-4)


def test_every_point_of_a_sparse_cloud_lies_on_the_mesh():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(300, 3))
    points *= rng.uniform(3.0, 9.0, (300, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    mesher = Mesher(fused(points, carve=False))
    mesher.update()
    mesh = mesher.mesh()
    corners = mesh.vertices[mesh.triangles]
    places = np.concatenate([mesh.vertices, corners.mean(axis=1)])
    distance, _ = cKDTree(places).query(points @ POSE[:3, :3].T + POSE[:3, 3])
    assert distance.max() < 1.5 * VOXEL_M


def test_rays_beside_a_thin_pole_do_not_erase_it():
    azimuth, up = np.meshgrid(np.deg2rad(np.arange(-20.0, 20.0, 0.2)), np.arange(-1.0, 1.0, 0.1))
    pole = np.abs(azimuth) < np.deg2rad(0.3)
    distance = np.where(pole, 5.0, 9.0)
    points = np.stack(
        [distance * np.cos(azimuth), distance * np.sin(azimuth), up * distance / 5.0], axis=-1
    )
    blocks = BlockMap(TsdfConfig(voxel_size_m=VOXEL_M, truncation_m=TAU_M, weight_mode='constant'))
    for _ in range(5):
        PointIntegrator(blocks).integrate(points.reshape(-1, 3), np.eye(4))
    mesher = Mesher(blocks)
    mesher.update()
    nearest, _ = cKDTree(mesher.mesh().vertices).query(points[pole])
    assert (nearest < VOXEL_M).mean() > 0.95


def test_points_that_are_no_measurements_change_nothing():
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0], [0.1, 0.1, 0.0]])
    blocks = fused(points)
    assert blocks.num_blocks == 0
    assert fused(np.empty((0, 3))).num_blocks == 0


def test_colours_and_labels_are_kept():
    blocks = BlockMap(
        TsdfConfig(
            voxel_size_m=VOXEL_M,
            truncation_m=TAU_M,
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
    blocks = BlockMap(TsdfConfig(voxel_size_m=VOXEL_M, truncation_m=TAU_M))
    integrator, points = PointIntegrator(blocks), np.ones((2, 3))
    with pytest.raises(PoseError):
        integrator.integrate(points, np.zeros((4, 4)))
    with pytest.raises(CloudFormatError, match='labels: 3, expected 2'):
        integrator.integrate(points, np.eye(4), labels=np.zeros(3, int))
    far = np.eye(4)
    far[0, 3] = 1e9
    with pytest.raises(MapLimitError):
        integrator.integrate(points, far)
    assert blocks.num_blocks == 0
