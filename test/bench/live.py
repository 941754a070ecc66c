# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The node over DDS: latency from publish to ``~/changed``, drops, the highest rate, start and idle.

Three processes: a lidar (live_publisher.py), the node, and this one, which subscribes to
``~/changed`` and to ``~/normals`` at 2 Hz. Clouds are best effort through the shared memory that
the package configures. A rate is sustained if every cloud published comes back as a change. Idle
is a node that has mapped, with nothing coming in. The first start compiles all kernels anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

from test.bench.live_publisher import NUM_SCANS
from test.bench.options import Options
from test.bench.report import Row
from test.bench.street import Street

ROOT = Path(__file__).parents[2]
RATE_HZ = 20.0
RATES_HZ = (25.0, 30.0, 35.0, 40.0, 50.0, 60.0, 80.0)
SECONDS, SECONDS_A_RATE, SECONDS_IDLE = 15.0, 6.0, 8.0
TIMEOUT_S = 120.0
SETTLE_S = 2.0
"""From the last cloud until a node is idle: the full map goes out at 2 Hz, diagnostics at 1 Hz."""

IDLE_BUDGET = 3.0
WARM_BUDGETS = {'budget_s': 5.0, 'budget_cpu_s': 3.0}
COLD_BUDGETS = {'budget_s': 40.0, 'budget_cpu_s': 20.0}
BUDGET_VOXEL_M = 0.5
LATENCY_BUDGET_MS = {'p50_ms': 40.0, 'p99_ms': 100.0}
CPU_TICKS = os.sysconf('SC_CLK_TCK')


def run(options: Options) -> list[Row]:
    """Return rows of starts, latencies and rates; none without ROS."""
    try:
        import rclpy  # noqa: F401
    except ImportError:
        print('no rclpy: the node is not measured', file=sys.stderr)
        return []
    street = Street(options)
    street.prepare(NUM_SCANS)
    isolate()
    scale = min(1.0, options.scans / 100)  # --quick takes a quarter of the time
    rows = starts(options)
    for size_m in options.voxel_sizes_m:
        rows += rates(options, street, size_m, scale)
    return rows


def isolate() -> None:
    """Keep ROS traffic on this machine, in a domain of this run's own."""
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)


def starts(options: Options) -> list[Row]:
    """Return the time until the node is ready, and until all kernels are, cold and warm."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as cache:
        caches = {'NUMBA_CACHE_DIR': cache, 'PYTHONPYCACHEPREFIX': cache}
        for way, budgets in (('cold', COLD_BUDGETS), ('warm', WARM_BUDGETS)):
            begin = time.perf_counter()
            with Node(0.5, [], options.window, caches) as node:
                node.wait_for('ready:')
                row = {'s': time.perf_counter() - begin, 'cpu_s': node.cpu_s()}
                node.wait_for('all kernels ready')
                row['all_cpu_s'] = node.cpu_s()
            rows.append({'what': f'start {way}', **row, **budgets})
    return rows


def rates(options: Options, street: Street, size_m: float, scale: float) -> Iterator[Row]:
    """Yield rows for 20 Hz, for higher rates up to the first with drops, and for an idle node."""
    mount = list(street.simulation.drive.base_to_sensor)
    with Node(size_m, mount, options.window, {}) as node, listening() as listener:
        node.wait_for('ready:')
        publish(options, listener, RATE_HZ, 20)  # fills caches
        row = {**measure(options, node, listener, RATE_HZ, SECONDS * scale), 'voxel_m': size_m}
        budgets = LATENCY_BUDGET_MS if size_m == BUDGET_VOXEL_M else {}
        yield {**row, **{f'budget_{name}': value for name, value in budgets.items()}}
        for rate_hz in RATES_HZ:
            row = measure(options, node, listener, rate_hz, SECONDS_A_RATE * scale)
            yield {**row, 'voxel_m': size_m}
            if row['dropped']:
                break
        time.sleep(SETTLE_S)
        row = {'what': 'idle', 'cpu_percent': node.cpu_percent(SECONDS_IDLE * scale)}
        yield {**row, 'voxel_m': size_m, 'budget_percent': IDLE_BUDGET}


def measure(
    options: Options, node: Node, listener: Any, rate_hz: float, seconds: float
) -> dict[str, Any]:
    """Return the row of a rate."""
    before_s = node.cpu_s()
    stamps = publish(options, listener, rate_hz, round(rate_hz * seconds))
    cpu_s = node.cpu_s() - before_s
    came = [(listener.arrivals[s] - s) / 1e6 for s in stamps if s in listener.arrivals]
    achieved = (len(stamps) - 1) / (stamps[-1] - stamps[0]) * 1e9
    return {
        'what': 'live',
        'rate_hz': rate_hz,
        'published_hz': achieved,
        'clouds': len(stamps),
        'dropped': len(stamps) - len(came),
        'p50_ms': float(np.percentile(came, 50)) if came else None,
        'p99_ms': float(np.percentile(came, 99)) if came else None,
        'cpu_ms_scan': 1e3 * cpu_s / len(stamps),
    }


def publish(options: Options, listener: Any, rate_hz: float, num: int) -> list[int]:
    """Let the lidar publish, and listen until a second has passed without a change."""
    settings = {
        'rate_hz': rate_hz,
        'num': num,
        'scans': NUM_SCANS,
        'beams': options.beams,
        'columns': options.columns,
        'cache': str(options.cache),
    }
    with subprocess.Popen(
        [sys.executable, '-m', 'test.bench.live_publisher', json.dumps(settings)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    ) as lidar:
        listener.listen_until(lambda: lidar.poll() is not None)
        output = lidar.stdout.read() if lidar.stdout else ''
    listener.listen_until(lambda: time.perf_counter() - listener.latest_s > 1.0)
    stamps: list[int] = json.loads(output.splitlines()[-1])
    return stamps


class Node:
    """The node as a process, in a with-block."""

    def __init__(
        self, voxel_size_m: float, mount: list[float], window: int, extra: dict[str, str]
    ) -> None:
        settings = {
            'pose.source': 'odometry',
            'frames.base_to_sensor': mount,
            'map.voxel_size_m': voxel_size_m,
            'window.max_scans': window,
            'publish.normals_rate_hz': 2.0,
        }
        self._output = tempfile.NamedTemporaryFile('w+')  # noqa: SIM115
        self._process = subprocess.Popen(
            [sys.executable, '-m', 'surfel_mapper.cli.main', 'node', '--ros-args']
            + [item for name, value in settings.items() for item in ('-p', f'{name}:={value}')],
            stdout=self._output,
            stderr=subprocess.STDOUT,
            cwd=ROOT,
            env={**os.environ, **extra, 'PYTHONDONTWRITEBYTECODE': ''},
        )

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGINT)
        self._process.wait(TIMEOUT_S)
        self._output.close()

    def wait_for(self, text: str) -> None:
        """Wait until the node has said something."""
        end_s = time.monotonic() + TIMEOUT_S
        while text not in (output := Path(self._output.name).read_text(encoding='utf-8')):
            if self._process.poll() is not None or time.monotonic() > end_s:
                raise RuntimeError(f'the node did not say {text!r}: {output}')
            time.sleep(0.02)

    def cpu_s(self) -> float:
        """Return the processor time of the node so far."""
        fields = Path(f'/proc/{self._process.pid}/stat').read_text().rpartition(')')[2].split()
        return (int(fields[11]) + int(fields[12])) / CPU_TICKS

    def cpu_percent(self, seconds: float) -> float:
        """Return the share of a core that the node takes for some time."""
        before_s = self.cpu_s()
        time.sleep(seconds)
        return 100.0 * (self.cpu_s() - before_s) / seconds


@contextmanager
def listening() -> Iterator[Any]:
    """Subscribe to the topics of the node, in a with-block."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import PointCloud2

    class Listener:
        """Notes when a change came, by its stamp."""

        def __init__(self) -> None:
            self.arrivals: dict[int, int] = {}
            self.latest_s = time.perf_counter()

        def on_changed(self, msg: PointCloud2) -> None:
            now_ns, self.latest_s = time.time_ns(), time.perf_counter()
            self.arrivals[msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec] = now_ns

        def listen_until(self, condition: Any) -> None:
            self.latest_s = time.perf_counter()
            while not condition():
                executor.spin_once(0.05)

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('listener', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    listener = Listener()
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(PointCloud2, '/surfel_mapper/changed', listener.on_changed, 50)
    node.create_subscription(PointCloud2, '/surfel_mapper/normals', lambda _: None, latched)
    try:
        yield listener
    finally:
        executor.shutdown()
        node.destroy_node()
        context.shutdown()
