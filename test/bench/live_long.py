# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The node over DDS for long: 20 Hz by defaults and with the profile, bursts, 40 Hz, memory.

Processes, topics and columns are those of the bench ``live``; its settings are defaults but for
the source of poses and the window. The window is full before the first row, so memory that
grows in a row is kept for other reasons. ``dropped`` counts the clouds without a message on
``~/changed``. ``normals_max_ms`` counts while clouds come; ``normals_last_ms`` is the age of the
message after the last cloud, which waits for its turn of the rate of 2 Hz.

A row at 20 Hz lasts a minute, with ``--scans 1000`` ten. The rows ``transport``, of a subscriber
that only takes the clouds, last two: by defaults Fast DDS repeats parts of clouds, and after 2 GiB
of these, 40 to 70 s, an error in its byte count delays clouds by up to half a second.
"""

from __future__ import annotations

from collections.abc import Iterator

from test.bench.live import (
    BUDGET_VOXEL_M,
    BURST,
    BURST_HZ,
    LATENCY_BUDGET_MS,
    listening,
    measure,
    Node,
    publish,
    RATE_HZ,
    street_over_dds,
    transport,
)
from test.bench.options import Options
from test.bench.report import Row

SECONDS, SECONDS_FAST, SECONDS_TRANSPORT = 60.0, 15.0, 120.0
FAST_HZ = 40.0
BUDGETS = {f'budget_{name}': value for name, value in {**LATENCY_BUDGET_MS, 'dropped': 0}.items()}


def run(options: Options) -> list[Row]:
    """Return a row for every rate, by defaults and with the profile; none without ROS."""
    scale = options.scans / 100
    with street_over_dds(options) as street:
        if not street:
            return []
        mount = list(street.simulation.drive.base_to_sensor)
        seconds = SECONDS_TRANSPORT * min(scale, 1.0)
        return [*transport(options, seconds), *rows(options, mount, scale)]


def rows(options: Options, mount: list[float], scale: float) -> Iterator[Row]:
    """Yield the rows of one node."""
    seconds, seconds_fast = SECONDS * scale, SECONDS_FAST * min(scale, 1.0)
    with Node(BUDGET_VOXEL_M, mount, options.window, {}) as node, listening() as listener:
        node.wait_for('all kernels ready')
        publish(options, listener.listen_until, RATE_HZ, options.window + 20, profile=True)
        for what, profile in (('defaults', False), ('with profile', True)):
            steady = measure(options, node, listener, RATE_HZ, seconds, profile=profile)
            yield {**steady, 'what': what, **BUDGETS}
            burst = measure(options, node, listener, BURST_HZ, BURST / BURST_HZ, profile=profile)
            yield {**burst, 'what': f'burst {what}', 'budget_dropped': 0}
            fast = measure(options, node, listener, FAST_HZ, seconds_fast, profile=profile)
            yield {**fast, 'what': what}
