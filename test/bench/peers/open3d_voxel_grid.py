# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Times Open3D's voxel_down_sample; runs in its environment.

Arguments: the file of the points, the voxel size in m, repeats. Prints the processor times in
milliseconds and how many points are left, for clouds of the older interface and of tensors.
"""

from __future__ import annotations

import json
import sys
from time import process_time

import numpy as np
import open3d


def main() -> None:
    """Do the job."""
    path, size_m, repeats = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
    points = np.load(path)
    clouds = {
        'Open3D': open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)),
        'Open3D, tensors': open3d.t.geometry.PointCloud(points),
    }
    result = {}
    for name, cloud in clouds.items():
        times = []
        for _ in range(repeats):
            start = process_time()
            left = cloud.voxel_down_sample(size_m)
            times.append((process_time() - start) * 1e3)
        positions = left.point.positions if hasattr(left, 'point') else left.points
        result[name] = [times, len(positions)]
    print(json.dumps(result))


if __name__ == '__main__':
    main()
