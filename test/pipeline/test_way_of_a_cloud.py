# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The way of a cloud through the package is short: modules and functions from bytes to columns.

Counted are the frames that sys.setprofile reports, comprehensions and kernels among them, from the
serialised PointCloud2 to the columns of ~/changed, with the default settings, poses from odometry,
one thread, and a full window. A cloud with more modules and functions is harder to follow.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
import sys

from numba import config as numba_config
import numpy as np
import pytest

import surfel_mapper
from surfel_mapper.config import Config
from surfel_mapper.mapping.surfels import surfel_columns
from surfel_mapper.messages.pointcloud2 import cloud_bytes, from_columns, parse_cloud, to_scan
from surfel_mapper.pipeline import Mapper
from test.pipeline.made_scans import LEVEL, S

MOST_MODULES, MOST_FUNCTIONS = 20, 110

PACKAGE = Path(surfel_mapper.__file__).parent


def cloud_at(number):
    """Return the bytes of a cloud of 3,000 points on a floor and a wall."""
    x, y, z = np.random.default_rng(number).uniform(-5.0, 5.0, (3, 3000)).astype(np.float32)
    z[::2], x[1::2] = -1.0, 5.0
    cloud = from_columns({'x': x, 'y': y, 'z': z, 'intensity': x})
    return cloud_bytes(cloud, stamp_ns=number * S, frame_id='lidar')


def changed_columns(mapper, raw):
    """Take a cloud as the node does; return the columns of ~/changed."""
    mapper.add_scan(to_scan(parse_cloud(raw, topic='/points'), '/points'), '/points')
    return [surfel_columns(update.changed) for update in mapper.insert_ready()]


def functions_called(work, *args):
    """Return the result of a function, and the functions of the package that it called by file."""
    called = defaultdict(set)

    def note(frame, event, _):
        path = Path(frame.f_code.co_filename)
        if event == 'call' and PACKAGE in path.parents:
            called[path.relative_to(PACKAGE).as_posix()].add(frame.f_code)

    sys.setprofile(note)
    try:
        result = work(*args)
    finally:
        sys.setprofile(None)
    return result, called


@pytest.mark.skipif(numba_config.DISABLE_JIT, reason='interpreted kernels call further functions')
def test_a_cloud_passes_few_modules_and_functions():
    mounted = {'frames.base_to_sensor': (0.0, 0.0, 1.0, *LEVEL)}
    mapper = Mapper(
        Config.from_mapping({'pose.source': 'odometry', 'window.max_scans': 5, **mounted})
    )
    for number in range(1, 10):
        mapper.add_pose('odom', 'base_link', number * S, (0.1 * number, 0.0, 0.0), LEVEL)
        columns, called = functions_called(changed_columns, mapper, cloud_at(number))

    assert len(columns[0]['num_points']) > 0
    assert mapper.counters.evicted == {'max_scans': 4}
    listed = '\n'.join(
        f'{file}: {", ".join(sorted(code.co_name for code in codes))}'
        for file, codes in sorted(called.items())
    )
    num_functions = sum(map(len, called.values()))
    assert (len(called) <= MOST_MODULES, num_functions <= MOST_FUNCTIONS) == (True, True), (
        f'{len(called)} modules and {num_functions} functions, expected at most {MOST_MODULES} '
        f'and {MOST_FUNCTIONS}:\n{listed}'
    )
