# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Find planes with Open3D, and label the points of the cloud by them.

Runs in an environment of its own. Arguments: the file of the points, the file for the labels, the
method (``planar patches`` or ``RANSAC``), and the voxel size of the thinning before. Prints the
milliseconds that the planes took, labels not included, as JSON.
"""

from __future__ import annotations

import json
import sys
from time import process_time

import numpy as np
import open3d

NEIGHBOURS = 30
MOST_PLANES, LEAST_POINTS, NEAR_M = 12, 500, 0.01


def planar_patches(points, voxel_size_m):
    """Return the label of every point, by the smallest box that it lies in, and the time."""
    start = process_time()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud = cloud.voxel_down_sample(voxel_size_m)
    search = open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS)
    cloud.estimate_normals(search)
    boxes = cloud.detect_planar_patches(search_param=search)
    duration = (process_time() - start) * 1e3
    label = np.full(len(points), -1, np.int32)
    whole = open3d.utility.Vector3dVector(points)
    boxes = sorted(boxes, key=lambda box: -box.extent[0] * box.extent[1])
    for number, box in enumerate(boxes):
        wide = np.add(np.maximum(box.extent, 0.0), [voxel_size_m, voxel_size_m, 0.0])
        wide[2] = max(wide[2], 2.0 * NEAR_M)
        grown = open3d.geometry.OrientedBoundingBox(box.center, box.R, wide)
        label[grown.get_point_indices_within_bounding_box(whole)] = number
    return label, duration


def ransac(points, voxel_size_m):
    """Return the label of every point, by planes found one after the other, and the time."""
    start = process_time()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    left, planes = cloud.voxel_down_sample(voxel_size_m), []
    while len(left.points) > LEAST_POINTS * 0.1 and len(planes) < MOST_PLANES:
        plane, inside = left.segment_plane(NEAR_M, 3, 300)
        if len(inside) < LEAST_POINTS * 0.1:
            break
        planes.append(plane)
        left = left.select_by_index(inside, invert=True)
    duration = (process_time() - start) * 1e3
    label = np.full(len(points), -1, np.int32)
    for number, (a, b, c, d) in enumerate(planes):
        near = np.abs(points @ [a, b, c] + d) < NEAR_M
        label[near & (label < 0)] = number
    return label, duration


def main() -> None:
    """Run the job."""
    source, result, method, voxel_size_m = sys.argv[1:]
    points = np.load(source).astype(np.float64)
    finite = np.isfinite(points).all(axis=1)
    open3d.utility.random.seed(0)
    find = ransac if method == 'RANSAC' else planar_patches
    label = np.full(len(points), -1, np.int32)
    label[finite], duration = find(points[finite], float(voxel_size_m))
    np.save(result, label)
    print(json.dumps(duration))


if __name__ == '__main__':
    main()
