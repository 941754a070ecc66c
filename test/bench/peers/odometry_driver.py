# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Feed scans to the odometry of one peer and time it; runs in the environment of the peer.

The job is JSON on stdin: the module, voxel_size_m, the files of the scans, and the file for the
poses, (S, 4, 4). JSON on stdout has clock time, processor time, which depends little on other
load, and the memory. Peers print progress on stdout, which goes to stderr here.
"""

from __future__ import annotations

from importlib import import_module
import json
import os
from pathlib import Path
import sys
from time import perf_counter, process_time

import numpy as np


def main() -> None:
    """Run the job."""
    job = json.load(sys.stdin)
    stdout = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)  # also for the C++ code of a peer
    odometry = import_module(job['module']).Odometry(job['voxel_size_m'])
    milliseconds, cpu_ms, poses = [], [], []
    for path in job['scans']:
        points = np.load(path)
        points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        start, cpu_start = perf_counter(), process_time()
        pose = odometry.register(points)
        milliseconds.append((perf_counter() - start) * 1e3)
        cpu_ms.append((process_time() - cpu_start) * 1e3)
        poses.append(np.array(pose))
    np.save(job['poses'], np.array(poses))
    result = {'milliseconds': milliseconds, 'cpu_ms': cpu_ms, 'peak_mb': peak_mb()}
    json.dump(result, stdout)
    stdout.close()


def peak_mb() -> float:
    """Return the peak memory of this program, MB; that of getrusage includes the parent's."""
    lines = Path('/proc/self/status').read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith('VmHWM:')) * 1.024e-3


if __name__ == '__main__':
    main()
