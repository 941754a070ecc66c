# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The node on a robot over DDS, by defaults: rates, sensors, layers, subscribers, load, 20 minutes.

One row a case, one number a cell; the first rows are the floor, a subscriber of rclpy that only
notes when clouds arrive. All cases take half an hour, in proportion to ``--scans``. The figures of
root and of an ordinary user differ by the real-time priority that Linux permits (docs/node.md):
``setpriv --bounding-set=-sys_nice --`` in front of the command measures as the latter.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass, field
import json
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from test.bench.live import latencies, listening, Node, ROOT, spinning, street_over_dds
from test.bench.live_publisher import NUM_SCANS
from test.bench.options import Options
from test.bench.report import Row

SECONDS, LONG_SECONDS = 30.0, 1200.0
"""Duration of a case, and of the last one, for the default of 100 scans, s."""

WARM_CLOUDS = 20

DEPTH = {'input.kind': 'depth', 'input.topics': "['depth/image']"}

LAYERS = {
    'layers.tsdf.enabled': 'true',
    'layers.models.enabled': 'true',
    'dynamic.clear': 'true',
    'grid.rate_hz': '1.0',
    'esdf.rate_hz': '1.0',
}

SUBSCRIBER = """
import rclpy
from sensor_msgs.msg import PointCloud2
rclpy.init()
node = rclpy.create_node('subscriber')
node.create_subscription(PointCloud2, '/surfel_mapper/changed', lambda msg: None, 10)
node.create_subscription(PointCloud2, '/surfel_mapper/normals', lambda msg: None, 1)
rclpy.spin(node)
"""


@dataclass(frozen=True, kw_only=True)
class Case:
    """
    A row of the table.

    Attributes
    ----------
    name : str
        Its first cell.
    rate_hz : float
        Clouds or images of a sensor in a second.
    settings : dict of str
        Settings of the node.
    topics : tuple of str
        Topics of the sensors.
    running, stopped : int
        Further subscribers, and those that are stopped by SIGSTOP.
    is_busy : bool
        Whether another process computes all the time.
    seconds : float
        Duration.

    """

    name: str
    rate_hz: float = 20.0
    settings: dict[str, str] = field(default_factory=dict)
    topics: tuple[str, ...] = ('points',)
    running: int = 0
    stopped: int = 0
    is_busy: bool = False
    seconds: float = SECONDS


FLOORS = tuple(Case(name='bare subscriber', rate_hz=rate_hz) for rate_hz in (10.0, 20.0, 40.0))

CASES = (
    *(Case(name='node', rate_hz=rate_hz) for rate_hz in (10.0, 20.0, 40.0)),
    Case(name='two lidars', rate_hz=10.0, topics=('points', 'points_1')),
    Case(name='depth camera', rate_hz=30.0, topics=('depth/image',), settings=DEPTH),
    Case(name='all layers', rate_hz=10.0, settings=LAYERS),
    Case(name='5 subscribers, 1 stopped', running=5, stopped=1),
    Case(name='busy loop beside it', is_busy=True),
    Case(name='20 minutes', seconds=LONG_SECONDS),
)


def run(options: Options) -> Iterator[Row]:
    """Yield the rows of the table; none without ROS."""
    with street_over_dds(options) as street:
        if not street:
            return
        permitted = {'priority': 'real time' if may_run_in_real_time() else 'ordinary'}
        for case in FLOORS:
            yield {**permitted, **floor(options, case)}
        mount = [float(value) for value in street.simulation.drive.base_to_sensor]
        for case in CASES:
            yield {**permitted, **measured(options, case, mount)}


def floor(options: Options, case: Case) -> Row:
    """Return the row of a subscriber that only notes arrivals."""
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import PointCloud2

    arrivals: dict[int, int] = {}

    def on_cloud(msg: PointCloud2) -> None:
        arrivals[msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec] = time.time_ns()

    with spinning() as (node, listen_until):
        node.create_subscription(PointCloud2, 'points', on_cloud, 20)
        node.create_subscription(Odometry, 'odom', lambda msg: None, 1000)
        publish(options, listen_until, case, WARM_CLOUDS)
        start_s, rss_mb = own_cpu_s(), own_resident_mb()
        stamps = publish(options, listen_until, case)
        cpu_s = own_cpu_s() - start_s
    return row(case, stamps, arrivals, '', (cpu_s, rss_mb, own_resident_mb()))


def measured(options: Options, case: Case, mount: list[float]) -> Row:
    """Return the row of the node."""
    further: dict[str, Any] = dict(case.settings)
    if len(case.topics) > 1:
        names = [f'lidar_{number}' for number in range(len(case.topics))]
        further |= {'input.topics': list(case.topics), 'frames.sensors': names}
        mount = mount * len(case.topics)
    with ExitStack() as stack:
        node = stack.enter_context(Node(0.5, mount, options.window, {}, further))
        listener = stack.enter_context(listening())
        node.wait_for('ready:')
        drops = stack.enter_context(counted_drops(listener))
        for number in range(case.running + case.stopped):
            stack.enter_context(subscriber(is_stopped=number >= case.running))
        if case.is_busy:
            stack.enter_context(busy_loop())
        publish(options, listener.listen_until, case, WARM_CLOUDS)
        start_s, rss_mb, before = node.cpu_s(), node.resident_mb(), dict(drops)
        stamps = publish(options, listener.listen_until, case)
        use = node.cpu_s() - start_s, rss_mb, node.resident_mb()
        causes = [
            f'{cause} {number - before.get(cause, 0)}'
            for cause, number in drops.items()
            if number > before.get(cause, 0)
        ]
    return row(case, stamps, listener.arrivals, ', '.join(causes), use)


def row(
    case: Case,
    stamps: list[int],
    arrivals: dict[int, int],
    causes: str,
    use: tuple[float, float, float],
) -> Row:
    """Return a row; ``use`` has processor time, s, and memory at start and end, MB."""
    return {
        'case': case.name,
        'hz': f'{case.rate_hz:g}',
        **latencies(stamps, arrivals),
        'causes': causes,
        'cpu_ms_scan': 1e3 * use[0] / len(stamps),
        'rss_start_MB': use[1],
        'rss_end_MB': use[2],
    }


def publish(options: Options, listen_until: Any, case: Case, num: int | None = None) -> list[int]:
    """Let the sensors publish, and listen until they end; return the stamps."""
    rate_hz = case.rate_hz * len(case.topics)
    settings = {
        'role': 'lidar',
        'rate_hz': rate_hz,
        'num': num or round(rate_hz * case.seconds * options.scans / 100),
        'scans': NUM_SCANS,
        'beams': options.beams,
        'columns': options.columns,
        'cache': str(options.cache),
        'topics': case.topics,
    }
    with tempfile.NamedTemporaryFile('w+', encoding='utf-8') as file:
        command = json.dumps({**settings, 'stamps': file.name})
        module = [sys.executable, '-m', 'test.bench.live_publisher', command]
        with subprocess.Popen(module, cwd=ROOT) as sensors:
            listen_until(lambda: sensors.poll() is not None)
        stamps: list[int] = json.load(file)
    return stamps


@contextmanager
def counted_drops(listener: Any) -> Iterator[dict[str, int]]:
    """Yield the scans dropped so far, by cause, as the node reports them."""
    from diagnostic_msgs.msg import DiagnosticArray

    drops: dict[str, int] = {}
    prefix = 'scans.dropped.'

    def on_report(msg: DiagnosticArray) -> None:
        for value in msg.status[0].values:
            cause = value.key.removeprefix(prefix)
            if value.key.startswith(prefix) or value.key == 'clouds_lost':
                drops[cause] = int(value.value)

    listener.node.create_subscription(DiagnosticArray, '/diagnostics', on_report, 10)
    yield drops


@contextmanager
def subscriber(*, is_stopped: bool) -> Iterator[None]:
    """Subscribe in a process of its own to the map, in a with-block."""
    process = subprocess.Popen([sys.executable, '-c', SUBSCRIBER])
    time.sleep(2.0)  # until it is discovered
    if is_stopped:
        process.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        process.kill()
        process.wait()


@contextmanager
def busy_loop() -> Iterator[None]:
    """Compute in another process, in a with-block."""
    process = multiprocessing.get_context('spawn').Process(target=compute, daemon=True)
    process.start()
    try:
        yield
    finally:
        process.kill()
        process.join()


def compute() -> None:
    """Compute until the process is killed."""
    while True:
        sum(range(10**6))


def may_run_in_real_time() -> bool:
    """Return whether Linux permits the priority that the node gives threads of the middleware."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except PermissionError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


def own_cpu_s() -> float:
    """Return the processor time of this process."""
    return time.process_time()


def own_resident_mb() -> float:
    """Return the largest memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
