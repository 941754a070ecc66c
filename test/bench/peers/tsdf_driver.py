# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Feed scans or depth images to one TSDF and time it; runs in the environment of the peer.

The job is JSON on stdin; clock and processor time of every scan are JSON on stdout, the mesh is a
file. Inputs are converted before timing starts.
"""

from __future__ import annotations

from importlib import import_module
import json
import sys
from time import perf_counter, process_time

import numpy as np


def main() -> None:
    """Run the job."""
    job = json.load(sys.stdin)
    peer = import_module(job['module']).Peer(job)
    times: list[tuple[float, float]] = []
    for path, pose in zip(job['scans'], np.load(job['poses']), strict=True):
        data = peer.prepared(np.load(path), pose)
        start, busy = perf_counter(), process_time()
        peer.integrate(data, pose)
        times.append(((perf_counter() - start) * 1e3, (process_time() - busy) * 1e3))
    mesh_ms = []
    for _ in range(job['meshes']):
        busy = process_time()
        vertices, triangles = peer.mesh()
        mesh_ms.append((process_time() - busy) * 1e3)
    np.savez(job['mesh'], vertices=vertices, triangles=triangles, mesh_ms=min(mesh_ms))
    json.dump(times, sys.stdout)


if __name__ == '__main__':
    main()
