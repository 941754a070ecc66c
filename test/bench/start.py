# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Processor time of the node until it is ready, has mapped a scan, and has all kernels: cold, warm.

Cold is a start without compiled kernels, as after an installation by pip or colcon, which compiles
the modules of Python. Without those either it is bare: a link to the sources, run for the first
time. A lidar already publishes, so the rest of the kernels compiles while scans are mapped.
"""

from __future__ import annotations

import sys
import tempfile
import time

from test.bench.live import isolate, Node, start_lidar
from test.bench.live_publisher import NUM_SCANS
from test.bench.options import Options
from test.bench.report import Row
from test.bench.street import Street

RATE_HZ, NUM_CLOUDS = 10.0, 50
STARTS = (
    ('bare', 'first', {}),
    ('cold', 'second', {'budget_first_cpu_s': 15.0}),
    ('warm', 'second', {'budget_ready_cpu_s': 2.0}),
)
"""Name, directory of compiled kernels, and budgets of each start."""


def run(options: Options) -> list[Row]:
    """Return a row for a cold start and one for a warm start; none without ROS."""
    try:
        import rclpy  # noqa: F401
    except ImportError:
        print('no rclpy: the node is not measured', file=sys.stderr)
        return []
    street = Street(options)
    street.prepare(NUM_SCANS)
    isolate()
    mount = list(street.simulation.drive.base_to_sensor)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as cache:
        for way, kernels, budgets in STARTS:
            caches = {'NUMBA_CACHE_DIR': f'{cache}/{kernels}', 'PYTHONPYCACHEPREFIX': cache}
            rows.append({'what': f'start {way}', **start(options, mount, caches), **budgets})
    return rows


def start(options: Options, mount: list[float], caches: dict[str, str]) -> Row:
    """Return the times of one start."""
    with (
        tempfile.NamedTemporaryFile('w+', encoding='utf-8') as stamps,
        start_lidar(options, RATE_HZ, NUM_CLOUDS, stamps.name),
    ):
        begin = time.perf_counter()
        with Node(0.5, mount, options.window, caches) as node:
            node.wait_for('ready:')
            row = {'ready_s': time.perf_counter() - begin, 'ready_cpu_s': node.cpu_s()}
            node.wait_for('first scan mapped')
            row['first_cpu_s'] = node.cpu_s()
            node.wait_for('all kernels ready')
            row['all_cpu_s'] = node.cpu_s()
    return row
