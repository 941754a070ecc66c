# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The node over DDS at 20 Hz: latency from publish to ``~/changed``, and clouds that are lost.

Four processes: a lidar and an odometry (live_publisher.py), the node, and this one, which
subscribes to ``~/changed`` and to ``~/normals`` at 2 Hz. The lidar is an ordinary publisher:
reliable, with the defaults of the middleware, or, in rows ``with profile``, with the profile for
shared memory. The rows by defaults depend on whether Linux permits the node real-time priority
(docs/node.md); without: ``setpriv --bounding-set=-sys_nice -- python -m test.bench --only live``
as root.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
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

from surfel_mapper.ros.context import PROFILE
from test.bench.live_publisher import NUM_SCANS
from test.bench.options import Options
from test.bench.report import Row
from test.bench.street import Street
from test.ros.domain import domain_of_our_own

ROOT = Path(__file__).parents[2]
RATE_HZ = 20.0
SECONDS = 15.0
TIMEOUT_S = 300.0

Listen = Callable[[Callable[[], bool]], None]
"""Takes messages until a condition holds."""

CPU_TICKS = os.sysconf('SC_CLK_TCK')


def run(options: Options) -> list[Row]:
    """Return rows of latencies; none without ROS."""
    rows: list[Row] = []
    with street_over_dds(options) as street:
        if street:
            for size_m in options.voxel_sizes_m:
                rows += latency_rows(options, street, size_m)
    return rows


@contextmanager
def street_over_dds(options: Options) -> Iterator[Street | None]:
    """Prepare the scans and a ROS domain for a with-block; None without ROS, which is printed."""
    if find_spec('rclpy') is None:
        print('no rclpy: the node is not measured', file=sys.stderr)
        yield None
        return
    street = Street(options)
    street.prepare(NUM_SCANS)
    with domain_of_our_own():
        yield street


def latency_rows(options: Options, street: Street, size_m: float) -> Iterator[Row]:
    """Yield a row for a lidar with the defaults of the middleware, and one with the profile."""
    mount = list(street.simulation.drive.base_to_sensor)
    seconds = SECONDS * options.scans / 100
    with Node(size_m, mount, options.window, {}) as node, listening() as listener:
        node.wait_for('ready:')
        publish(options, listener.listen_until, 20)  # fills caches
        for what, profile in (('live', False), ('with profile', True)):
            row = measure(options, node, listener, seconds, profile=profile)
            yield {'what': what, 'voxel_m': size_m, **row}


def measure(
    options: Options, node: Node, listener: Any, seconds: float, *, profile: bool
) -> dict[str, Any]:
    """Return the row of a lidar."""
    before_s, rss_mb = node.cpu_s(), node.resident_mb()
    num = round(RATE_HZ * seconds)
    stamps = publish(options, listener.listen_until, num, profile=profile)
    cpu_s = node.cpu_s() - before_s
    return {
        **latencies(stamps, listener.arrivals),
        'rss_MB': node.resident_mb(),
        'rss_grown_MB': node.resident_mb() - rss_mb,
        'cpu_ms_scan': 1e3 * cpu_s / len(stamps),
    }


def latencies(stamps: Sequence[int], arrivals: Mapping[int, int]) -> dict[str, Any]:
    """Return the number of clouds received, and their latencies."""
    came = [(arrivals[s] - s) / 1e6 for s in stamps if s in arrivals]
    return {
        'clouds': len(stamps),
        'dropped': len(stamps) - len(came),
        'p50_ms': float(np.percentile(came, 50)) if came else None,
        'p99_ms': float(np.percentile(came, 99)) if came else None,
    }


def publish(
    options: Options, listen_until: Listen, num: int, *, profile: bool = False
) -> list[int]:
    """Let the lidar publish, and listen until it ends; return the stamps."""
    with tempfile.NamedTemporaryFile('w+', encoding='utf-8') as file:
        with start_lidar(options, RATE_HZ, num, file.name, profile=profile) as lidar:
            listen_until(lambda: lidar.poll() is not None)
        stamps: list[int] = json.load(file)
    return stamps


def start_lidar(
    options: Options, rate_hz: float, num: int, stamps: str, *, profile: bool = False
) -> subprocess.Popen[bytes]:
    """Start the lidar, which publishes once the node subscribes, and then writes its stamps."""
    settings = {
        'role': 'lidar',
        'rate_hz': rate_hz,
        'num': num,
        'scans': NUM_SCANS,
        'beams': options.beams,
        'columns': options.columns,
        'cache': str(options.cache),
        'stamps': stamps,
    }
    command = [sys.executable, '-m', 'test.bench.live_publisher', json.dumps(settings)]
    environment = {'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROFILE)} if profile else {}
    return subprocess.Popen(command, cwd=ROOT, env={**os.environ, **environment})


class Node:
    """
    The node as a process, in a with-block.

    Attributes
    ----------
    final : str
        Its output, after the block.

    """

    def __init__(
        self,
        voxel_size_m: float,
        mount: list[float],
        window: int,
        extra: dict[str, str],
        further: Mapping[str, Any] | None = None,
    ) -> None:
        settings: dict[str, Any] = {
            'pose.source': 'odometry',
            'frames.base_to_sensor': mount,
            'map.voxel_size_m': voxel_size_m,
            'window.max_scans': window,
            'publish.normals_rate_hz': 2.0,
            **(further or {}),
        }
        self.final = ''
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
        self.final = self.text()
        self._output.close()

    def text(self) -> str:
        """Return the output of the node so far."""
        return Path(self._output.name).read_text(encoding='utf-8')

    def wait_for(self, text: str) -> None:
        """Wait until the output of the node contains a text."""
        end_s = time.monotonic() + TIMEOUT_S
        while text not in (output := self.text()):
            if self._process.poll() is not None or time.monotonic() > end_s:
                raise RuntimeError(f'the node did not say {text!r}: {output}')
            time.sleep(0.02)

    def cpu_s(self) -> float:
        """Return the processor time of the node so far."""
        fields = Path(f'/proc/{self._process.pid}/stat').read_text().rpartition(')')[2].split()
        return (int(fields[11]) + int(fields[12])) / CPU_TICKS

    def resident_mb(self) -> float:
        """Return the memory of the node."""
        pages = int(Path(f'/proc/{self._process.pid}/statm').read_text().split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE') / 2**20


@contextmanager
def listening() -> Iterator[Any]:
    """Subscribe to the topics of the node, in a with-block."""
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import PointCloud2

    class Listener:
        """Records arrivals of changes by stamp."""

        def __init__(self, node: Any, listen_until: Listen) -> None:
            self.node = node
            self.arrivals: dict[int, int] = {}
            self.listen_until = listen_until

        def on_changed(self, msg: PointCloud2) -> None:
            stamp = msg.header.stamp
            self.arrivals[int(stamp.sec * 10**9 + stamp.nanosec)] = time.time_ns()

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    with spinning() as (node, listen_until):
        listener = Listener(node, listen_until)
        node.create_subscription(PointCloud2, '/surfel_mapper/changed', listener.on_changed, 50)
        node.create_subscription(PointCloud2, '/surfel_mapper/normals', lambda _: None, latched)
        yield listener


@contextmanager
def spinning() -> Iterator[tuple[Any, Listen]]:
    """Create a node; yield it and a function that takes messages until a condition holds."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('listener', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def listen_until(condition: Callable[[], bool]) -> None:
        while not condition():
            executor.spin_once(0.05)

    try:
        yield node, listen_until
    finally:
        executor.shutdown()
        node.destroy_node()
        context.shutdown()
