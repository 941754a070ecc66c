# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Harnesses of LAS files, of files that ``view`` shows, and of captures of packets."""

from __future__ import annotations

from functools import cache
from pathlib import Path
import tempfile

import numpy as np

from surfel_mapper.viz.contents import contents
from test.fuzz.files import folder, refused
from test.fuzz.mutations import mutations
from test.fuzz.source import Source

SHOWN = ('.obj', '.stl', '.glb')


def shown(data: bytes) -> None:
    """Read a file that ``view`` shows; the first byte selects its kind."""
    suffix = SHOWN[data[0] % len(SHOWN) if data else 0]
    refused(lambda path: [*contents(path)], f'input{suffix}', data[1:])


@cache
def capture() -> tuple[bytes, bytes]:
    """Return a capture of two small scans of an Ouster lidar, and its metadata."""
    from ouster.sdk import core, pcap

    info = core.SensorInfo.from_default(core.LidarMode('512x10'))
    info.config.udp_port_lidar, info.config.udp_port_imu = 7502, 7503
    packets = []
    for number in range(2):
        frame = core.LidarFrame(info)
        frame.frame_id = number
        frame.field('RANGE')[:] = 5000
        frame.measurement_id[:] = np.arange(512)
        frame.timestamp[:] = 10**18 + number * 10**8 + np.arange(512)
        frame.packet_timestamp[:] = frame.timestamp[:: 512 // len(frame.packet_timestamp)]
        frame.status[:] = 1
        packets += core.frame_to_packets(frame, core.PacketFormat(info), 0, 0)[:3]
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, 'a.pcap')
        pcap.record(packets, str(path))
        return path.read_bytes(), info.to_json_string().encode()


def packets(data: bytes) -> None:
    """Read a capture and its metadata, one of which is changed."""
    from surfel_mapper.offline.ouster_pcap import OusterPcap

    source = Source(data)
    originals = capture()
    number, seed = source.below(2), source.below(1 << 16)
    *_, changed = mutations([originals[number]], 1, seed=seed)
    captured, described = (changed, originals[1]) if number == 0 else (originals[0], changed)
    Path(folder().name, 'capture.json').write_bytes(described)

    def read(path: Path) -> None:
        found = OusterPcap(path)
        for scan in range(min(len(found.files), 5)):
            found.scan(scan)

    refused(read, 'capture.pcap', captured)
