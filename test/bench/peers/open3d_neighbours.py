# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Times Open3D's normals and statistical outliers; runs in its environment.

Arguments: the file of the points, a row of jobs ``normals K`` or ``outliers K``, repeats. Prints
the processor times in milliseconds by job.
"""

from __future__ import annotations

import json
import sys
from time import process_time

import numpy as np
import open3d


def main() -> None:
    """Do the jobs."""
    path, jobs, repeats = sys.argv[1], sys.argv[2].split(','), int(sys.argv[3])
    points = np.load(path).astype(np.float64)
    result = {}
    for job in jobs:
        what, number = job.split()
        times = []
        for _ in range(repeats):
            cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
            start = process_time()
            if what == 'normals':
                cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(int(number)))
            else:
                cloud.remove_statistical_outlier(int(number), 2.0)
            times.append((process_time() - start) * 1e3)
        result[job] = times
    print(json.dumps(result))


if __name__ == '__main__':
    main()
