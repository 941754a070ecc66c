# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Times voxel grids, normals and outliers of a package; runs in its environment.

Arguments: the file of the points, the package, and tasks ``name value repeats``, separated by
commas. Prints, by task, the processor times in milliseconds and the number of points that are
left, None where the package lacks the task. Clouds are made outside of the times.
"""

from __future__ import annotations

import json
import sys
from time import process_time

import numpy as np


def open3d_calls(points):
    """Return the calls of Open3D by task, each of a value."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    nearest = open3d.geometry.KDTreeSearchParamKNN
    return {
        'grid': lambda size_m: len(cloud.voxel_down_sample(size_m).points),
        'normals': lambda number: cloud.estimate_normals(nearest(int(number))),
        'outliers': lambda number: len(cloud.remove_statistical_outlier(int(number), 2.0)[1]),
    }


def small_gicp_calls(points):
    """Return the calls of small_gicp by task."""
    import small_gicp

    cloud, one = small_gicp.PointCloud(points), {'num_threads': 1}
    return {
        'grid': lambda size_m: small_gicp.voxelgrid_sampling(cloud, size_m, **one).size(),
        'normals': lambda number: small_gicp.estimate_normals(
            cloud, num_neighbors=int(number), **one
        ),
    }


def main() -> None:
    """Do the tasks."""
    path, package, tasks = sys.argv[1:]
    points = np.load(path).astype(np.float64)
    result = {}
    for task in tasks.split(','):
        name, value, repeats = task.split()
        times = []
        for _ in range(int(repeats)):
            call = globals()[f'{package}_calls'](points).get(name)
            if call is None:
                break
            start = process_time()
            num_left = call(float(value))
            times.append((process_time() - start) * 1e3)
        result[task] = [times, num_left] if times else None
    print(json.dumps(result))


if __name__ == '__main__':
    main()
