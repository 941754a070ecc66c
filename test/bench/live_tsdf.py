# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The distance field in the node over DDS: drops, latency, and what field and mesh cost a scan.

A lidar of 131,072 points at 10 Hz, as in live.py; the node runs on one core, with the layer as in
launch_configs/spinning_lidar.yaml, and carves. Rows: without the field, with it, and with a reader
of ``~/mesh`` or ``~/mesh_tiles`` too; ``more_ms`` is the processor time of a scan beyond that of
the row it names.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from test.bench.live import latencies, listening, Node, publish, street_over_dds
from test.bench.options import Options
from test.bench.report import Row
from test.bench.street import Street

PRESET = Path(__file__).parents[2] / 'launch_configs' / 'spinning_lidar.yaml'
RATE_HZ = 10.0
WARM, SECONDS = 30, 30.0

MESSAGES = {'mesh': 'Marker', 'mesh_tiles': 'MarkerArray'}


def live_rows(options: Options) -> Iterator[Row]:
    """Yield the rows; none without ROS."""
    seconds = SECONDS * min(options.scans / 100, 1.0)
    with street_over_dds(options) as street:
        if not street:
            return
        none = measured(options, street, seconds, has_field=False, reader='')
        yield none
        field = measured(options, street, seconds, has_field=True, reader='')
        yield {**field, 'more_than': none['case'], 'more_ms': beyond(field, none)}
        for reader in MESSAGES:
            row = measured(options, street, seconds, has_field=True, reader=reader)
            yield {**row, 'more_than': field['case'], 'more_ms': beyond(row, field)}


def beyond(row: Row, other: Row) -> float:
    """Return the processor time of a scan beyond that of another row, ms."""
    return float(row['cpu_ms']) - float(other['cpu_ms'])


def measured(
    options: Options, street: Street, seconds: float, *, has_field: bool, reader: str
) -> Row:
    """Return the row of a node with or without the layer, and a reader of its mesh."""
    mount = list(street.simulation.drive.base_to_sensor)
    layer = yaml.safe_load(PRESET.read_text())['/**']['ros__parameters']['layers']['tsdf']
    further = {f'layers.tsdf.{key}': value for key, value in layer.items()}
    further |= {'layers.tsdf.enabled': has_field}
    with Node(0.5, mount, options.window, {}, further) as node, listening() as listener:
        with reading(reader) as sizes:
            node.wait_for('ready:')
            node.keep_to_one_core()
            publish(options, listener.listen_until, RATE_HZ, WARM)
            before_s, num_before = node.cpu_s(), len(sizes)
            stamps = publish(options, listener.listen_until, RATE_HZ, round(RATE_HZ * seconds))
            cpu_ms = 1e3 * (node.cpu_s() - before_s) / len(stamps)
        if 'switched off' in node.text():
            raise RuntimeError(f'the layer failed: {node.text()}')
    row = {'case': 'live, ' + ('field' if has_field else 'no field'), 'who': 'surfel_mapper'}
    if reader:
        late = sizes[num_before:]
        row['case'] += f', ~/{reader} read'
        row |= {'messages': len(late), 'MB': sum(late) / 1e6 / max(len(late), 1)}
    return {**row, 'cpu_ms': cpu_ms, **latencies(stamps, listener.arrivals)}


@contextmanager
def reading(topic: str) -> Iterator[list[int]]:
    """Read a topic of the node in a thread, in a with-block; yield the sizes of its messages."""
    from threading import Thread

    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from visualization_msgs import msg

    sizes: list[int] = []
    if not topic:
        yield sizes
        return

    def on_message(raw: Any) -> None:
        sizes.append(len(raw))

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('reader', context=context)
    latched = QoSProfile(depth=8, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    kind = getattr(msg, MESSAGES[topic])
    node.create_subscription(kind, f'/surfel_mapper/{topic}', on_message, latched, raw=True)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        yield sizes
    finally:
        executor.shutdown()
        thread.join()
        node.destroy_node()
        context.shutdown()
