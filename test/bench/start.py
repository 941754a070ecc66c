# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Processor time of the node until it is ready and until the first scan is mapped, cold and warm.

The node subscribes once all kernels are compiled. Then it is ready, and the first scan that comes
is mapped and published (``~/changed``, ``~/normals``). Clouds are those of a lidar of 10 Hz, by
the defaults of the middleware. Dropped are those that were not mapped, lost on the way or in the
node.

Cold is a start without compiled kernels, as after an installation by pip or colcon, which compiles
the modules of Python. Without those either it is bare: a link to the sources, run for the first
time.
"""

from __future__ import annotations

import json
import re
import tempfile
import time

from test.bench.live import Node, start_lidar, street_over_dds, TIMEOUT_S
from test.bench.options import Options
from test.bench.report import Row

RATE_HZ, SECONDS = 10.0, {'bare': 40.0, 'cold': 40.0, 'warm': 5.0}

REPORT = re.compile(r'scans received \d+, mapped (\d+)')
STARTS = (
    ('bare', 'first'),
    ('cold', 'second'),
    ('warm', 'second'),
)
"""Name and directory of compiled kernels of each start."""


def run(options: Options) -> list[Row]:
    """Return a row for each start, bare, cold and warm; none without ROS."""
    rows: list[Row] = []
    with street_over_dds(options) as street, tempfile.TemporaryDirectory() as cache:
        if not street:
            return []
        mount = list(street.simulation.drive.base_to_sensor)
        for way, kernels in STARTS:
            caches = {'NUMBA_CACHE_DIR': f'{cache}/{kernels}', 'PYTHONPYCACHEPREFIX': cache}
            row = start(options, mount, caches, way)
            rows.append({'what': f'start {way}', **row})
    return rows


def start(options: Options, mount: list[float], caches: dict[str, str], way: str) -> Row:
    """Return the times of one start."""
    with (
        tempfile.NamedTemporaryFile('w+', encoding='utf-8') as stamps,
        start_lidar(options, RATE_HZ, round(RATE_HZ * SECONDS[way]), stamps.name) as lidar,
    ):
        begin = time.perf_counter()
        with Node(0.5, mount, options.window, caches) as node:
            node.wait_for('ready:')
            row = {'ready_s': time.perf_counter() - begin, 'ready_cpu_s': node.cpu_s()}
            node.wait_for('first scan mapped')
            row['first_cpu_s'] = node.cpu_s()
            lidar.wait(TIMEOUT_S)
        clouds = len(json.load(stamps))
    report = REPORT.search(node.final)
    assert report, node.final
    return {**row, 'clouds': clouds, 'dropped': clouds - int(report[1])}
