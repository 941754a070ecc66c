# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Find planar patches with Open3D in a cloud without normals.

Runs in an environment of its own. Arguments: the file of the points, the voxel size of the
thinning before, 0 for none, and the number of runs. Prints the milliseconds of each and the
number of planes as JSON.
"""

from __future__ import annotations

import json
import sys
from time import perf_counter

import numpy as np
import open3d

NEIGHBOURS = 30


def planes(points, voxel_size_m):
    """Return the patches of a cloud."""
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if voxel_size_m > 0.0:
        cloud = cloud.voxel_down_sample(voxel_size_m)
    search = open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS)
    cloud.estimate_normals(search)
    return cloud.detect_planar_patches(search_param=search)


def main() -> None:
    """Run the job."""
    file, voxel_size_m, runs = sys.argv[1:]
    points = np.load(file).astype(np.float64)
    times = []
    for _ in range(int(runs)):
        start = perf_counter()
        found = planes(points, float(voxel_size_m))
        times.append((perf_counter() - start) * 1e3)
    print(json.dumps([times, len(found)]))


if __name__ == '__main__':
    main()
