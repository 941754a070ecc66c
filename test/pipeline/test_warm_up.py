# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The stages that compile kernels cover the kernels that scans then need."""

import subprocess
import sys

PROGRAM = """
from array import array
import gc
from types import SimpleNamespace

from numba.core.dispatcher import Dispatcher
import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.messages.pointcloud2 import cloud_bytes, from_columns, parse_cloud, to_scan
from surfel_mapper.pipeline import Mapper

def kernels():
    return {
        (kernel.py_func.__qualname__, signature)
        for kernel in gc.get_objects() if isinstance(kernel, Dispatcher)
        for signature in kernel.overloads
    }

def message(number, as_ros):
    points = np.random.default_rng(number).uniform(-1, 1, (2000, 3)).astype(np.float32)
    columns = {**dict(zip('xyz', points.T)), 'intensity': points[:, 0]}
    raw = cloud_bytes(from_columns(columns), stamp_ns=number * 10**8, frame_id='lidar')
    found = parse_cloud(raw)
    if not as_ros:
        return found
    names = ('header', 'height', 'width', 'fields', 'is_bigendian', 'point_step', 'row_step')
    parts = {name: getattr(found, name) for name in names}
    return SimpleNamespace(**parts, data=array('B', bytes(found.data)), is_dense=True)

def mapped(number):
    mapper.add_scan(to_scan(message(number, as_ros=number % 2)))
    return list(mapper.insert_ready())

mapper = Mapper(Config.from_mapping({'pose.source': 'identity', 'window.max_scans': 2}))
mapper.warm_up()
before = kernels()
updates = [update for number in range(1, 6) for update in mapped(number)]
assert len(updates[-1].changed) and updates[-1].evictions
print(sorted(map(str, kernels() - before)))
"""


def test_scans_need_no_kernel_beyond_those_of_the_stages():
    """In a new Python, whose kernels are loaded from the cache, not compiled, one by one."""
    done = subprocess.run(
        [sys.executable, '-c', PROGRAM], capture_output=True, text=True, check=False
    )
    assert (done.stdout.strip(), done.returncode) == ('[]', 0), done.stdout + done.stderr
