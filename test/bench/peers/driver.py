# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Feeds the scans to one peer and times it; runs in the environment of the peer.

The job comes as JSON on stdin, the times leave as JSON on stdout. Scans are in memory before
the clock starts. It stops early once timed scans have taken a second each on average, so that a
slow peer gets fewer.
"""

from __future__ import annotations

from importlib import import_module
import json
import sys
from time import perf_counter

import numpy as np

LEAST_SCANS = 5
"""So many scans are timed however long they take."""


def main() -> None:
    """Do the job."""
    job = json.load(sys.stdin)
    peer = import_module(job['module']).Peer(job['voxel_size_m'], job['window'])
    poses, untimed = np.load(job['poses']), job['untimed']
    for path, pose in zip(job['scans'][:untimed], poses, strict=False):
        peer.step(np.load(path), pose)
    scans = [np.load(path) for path in job['scans'][untimed:]]
    milliseconds: list[float] = []
    for points, pose in zip(scans, poses[untimed:], strict=True):
        start = perf_counter()
        peer.step(points, pose)
        milliseconds.append((perf_counter() - start) * 1e3)
        if len(milliseconds) >= LEAST_SCANS and sum(milliseconds) > 1e3 * len(scans):
            break
    json.dump({'milliseconds': milliseconds, 'num_voxels': peer.num_voxels}, sys.stdout)


if __name__ == '__main__':
    main()
