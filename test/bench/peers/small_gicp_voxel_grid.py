# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Times small_gicp's voxelgrid_sampling; runs in its environment.

Arguments: the file of the points, the voxel size in m, repeats. Prints the processor times in
milliseconds and how many points are left. The cloud is made before, outside of the times.
"""

from __future__ import annotations

import json
import sys
from time import process_time

import numpy as np
import small_gicp


def main() -> None:
    """Do the job."""
    path, size_m, repeats = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
    cloud = small_gicp.PointCloud(np.load(path).astype(np.float64))
    times = []
    for _ in range(repeats):
        start = process_time()
        left = small_gicp.voxelgrid_sampling(cloud, size_m, num_threads=1)
        times.append((process_time() - start) * 1e3)
    print(json.dumps({'small_gicp': [times, left.size()]}))


if __name__ == '__main__':
    main()
