# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Times small_gicp's normals; runs in its environment.

Arguments: the file of the points, a row of jobs ``normals K`` or ``outliers K``, repeats. Prints
the processor times in milliseconds by job.
"""

from __future__ import annotations

import json
import sys
from time import process_time

import numpy as np
import small_gicp


def main() -> None:
    """Do the jobs."""
    path, jobs, repeats = sys.argv[1], sys.argv[2].split(','), int(sys.argv[3])
    points = np.load(path).astype(np.float64)
    result = {}
    for job in jobs:
        what, number = job.split()
        times = []
        for _ in range(repeats):
            if what == 'outliers':  # it has none
                continue
            cloud = small_gicp.PointCloud(points)
            start = process_time()
            small_gicp.estimate_normals(cloud, num_neighbors=int(number), num_threads=1)
            times.append((process_time() - start) * 1e3)
        result[job] = times
    print(json.dumps(result))


if __name__ == '__main__':
    main()
