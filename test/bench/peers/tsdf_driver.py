# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Feeds scans or depth images to one TSDF and times it; runs in the environment of the peer.

The job comes as JSON on stdin, the times leave as JSON on stdout, the mesh as a file. What a peer
wants of its input in another form is done before its clock starts.
"""

from __future__ import annotations

from importlib import import_module
import json
import sys
from time import perf_counter

import numpy as np


def main() -> None:
    """Do the job."""
    job = json.load(sys.stdin)
    peer = import_module(job['module']).Peer(job)
    milliseconds: list[float] = []
    for path, pose in zip(job['scans'], np.load(job['poses']), strict=True):
        data = peer.prepared(np.load(path), pose)
        start = perf_counter()
        peer.integrate(data, pose)
        milliseconds.append((perf_counter() - start) * 1e3)
    start = perf_counter()
    vertices, triangles = peer.mesh()
    mesh_ms = (perf_counter() - start) * 1e3
    np.savez(job['mesh'], vertices=vertices, triangles=triangles)
    json.dump({'milliseconds': milliseconds, 'mesh_ms': mesh_ms}, sys.stdout)


if __name__ == '__main__':
    main()
