# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Feed the scans to one peer and time it; runs in the environment of the peer.

Reads the job as JSON from stdin and writes the times as JSON to stdout. Scans are in memory
before timing starts. It stops early if the timed ones take more than TIMED_S.

A peer that derives its result from the whole window may have ``fill``, which takes a scan into
the window without that; the untimed scans but the last are given to it.
"""

from __future__ import annotations

from importlib import import_module
import json
import sys
from time import perf_counter

import numpy as np

TIMED_S = 30.0
"""Time after which no further scan is timed, s."""

LEAST_SCANS = 3
"""Number of scans that are timed in any case."""


def main() -> None:
    """Run the job."""
    job = json.load(sys.stdin)
    peer = import_module(job['module']).Peer(job['voxel_size_m'], job['window'])
    poses, untimed = np.load(job['poses']), job['untimed']
    fill = getattr(peer, 'fill', peer.step)
    for number, path in enumerate(job['scans'][:untimed]):
        take = fill if number < untimed - 1 else peer.step
        take(np.load(path), poses[number])
    scans = [np.load(path) for path in job['scans'][untimed:]]
    milliseconds: list[float] = []
    for points, pose in zip(scans, poses[untimed:], strict=True):
        start = perf_counter()
        peer.step(points, pose)
        milliseconds.append((perf_counter() - start) * 1e3)
        if len(milliseconds) >= LEAST_SCANS and sum(milliseconds) > 1e3 * TIMED_S:
            break
    json.dump({'milliseconds': milliseconds, 'num_voxels': peer.num_voxels}, sys.stdout)


if __name__ == '__main__':
    main()
