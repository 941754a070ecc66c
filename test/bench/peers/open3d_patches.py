# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Times Open3D's detect_planar_patches with its defaults; runs in its environment.

Argument: the file of the points. Prints the least processor time of three runs in milliseconds,
normals from 30 neighbours included, and centre, axes and edges of the boxes of the patches.
"""

from __future__ import annotations

import json
import sys
from time import process_time

import numpy as np
import open3d


def main() -> None:
    """Do the job."""
    points = np.load(sys.argv[1])
    search = open3d.geometry.KDTreeSearchParamKNN(knn=30)
    times = []
    for _ in range(3):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        start = process_time()
        cloud.estimate_normals(search)
        boxes = cloud.detect_planar_patches(search_param=search)
        times.append((process_time() - start) * 1e3)
    patches = [[box.center.tolist(), *box.R.T.tolist(), box.extent.tolist()] for box in boxes]
    print(json.dumps({'cpu_ms': min(times), 'patches': patches}))


if __name__ == '__main__':
    main()
