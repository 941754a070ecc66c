# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The long drive of core.py through the node: a process of its own, fed over DDS as fast as it maps.

Stamps are those of a lidar of 10 Hz, so an hour of driving takes minutes. No more clouds are under
way than the node keeps waiting, and every one of them has to be mapped. In the end the node saves
its map, which is compared with a new map of the clouds of its window.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
import math
import os
from pathlib import Path
import tempfile
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from scipy.spatial.transform import Rotation

from surfel_mapper.config import Config
from surfel_mapper.files.map_state import load_map
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.messages.pointcloud2 import RawCloud, to_scan
from test.bench.live_publisher import ros_cloud
from test.bench.options import Options
from test.bench.report import Row
from test.bench.street import Street
from test.ros.live import Peer, Process, stamp
from test.soak.core import BASE, CONFIG, PERIOD_NS, there_and_back, TURN_M

UNDER_WAY = 15
"""Clouds sent and not yet known as mapped; the node lets 20 wait."""

MAPS = 'maps'
STALL_S = 60.0
"""Silence after which a node counts as hung, s."""

FIRST_NS = 1_700_000_000_000_000_000


class Drive:
    """A node, and the peer that feeds it."""

    def __init__(self, folder: Path, options: Options) -> None:
        street = Street(options)
        street.prepare(options.scans)
        self.raw = [street.message(number) for number in range(options.scans)]
        self._messages = [ros_cloud(raw) for raw in self.raw]
        self._poses = [street.pose(number) for number in range(options.scans)]
        self.latest: deque[RawCloud] = deque(maxlen=CONFIG['window.max_scans'])
        settings = {**CONFIG, 'publish.diagnostics_rate_hz': 50.0, 'output.directory': MAPS}
        given = [item for k, v in settings.items() for item in ('-p', f'{k}:={v}')]
        self.node = Process(['node', '--ros-args', *given], folder)
        self.peer = Peer()
        self._reports = self.peer.collect(DiagnosticArray, '/diagnostics', QoSProfile(depth=1))
        self.peer.spin_until(lambda: self._reports)
        self.peer.advertise('/odom', '/points')

    def close(self) -> None:
        """Stop the node and the peer."""
        self.peer.close()
        self.node.kill()

    def send(self, number: int, turn: int, place: int) -> None:
        """Send the pose and the cloud of a scan."""
        stamp_ns = FIRST_NS + number * PERIOD_NS
        pose = Odometry(child_frame_id=BASE)
        pose.header.frame_id = 'odom'
        stamp(pose, stamp_ns)
        T_odom_sensor = self._poses[place]
        at, turned = pose.pose.pose.position, pose.pose.pose.orientation
        at.x, at.y, at.z = (float(value) for value in T_odom_sensor[:3, 3] + TURN_M * turn)
        quaternion = Rotation.from_matrix(T_odom_sensor[:3, :3]).as_quat()
        turned.x, turned.y, turned.z, turned.w = (float(value) for value in quaternion)
        message = self._messages[place]
        stamp(message, stamp_ns)
        self.peer.publish('/odom', pose)
        self.peer.publish('/points', message)
        self.latest.append(self.raw[place])

    def values(self) -> dict[str, str]:
        """Return the newest diagnostics."""
        del self._reports[:-1]
        return {item.key: item.value for item in self._reports[-1].status[0].values}

    def wait_for(self, num_mapped: int) -> None:
        """Wait until ``number`` scans are mapped."""
        self.peer.spin_until(
            lambda: int(self.values()['scans.mapped']) >= num_mapped,
            STALL_S,
            what=lambda: f'{num_mapped} scans not mapped: {self.values()}',
        )

    def resident_bytes(self) -> int:
        """Return the memory of the node."""
        statm = Path(f'/proc/{self.node._process.pid}/statm').read_text(encoding='ascii')
        return int(statm.split()[1]) * os.sysconf('SC_PAGE_SIZE')


def run(num_scans: int, block: int, options: Options, most_s: float = math.inf) -> Iterator[Row]:
    """
    Yield a row for every block of scans, up to a number of scans or a time.

    Raises
    ------
    RuntimeError
        If a scan was not mapped, or the map is not the sum of its window in the end.

    """
    with tempfile.TemporaryDirectory(prefix='surfel_mapper-soak-') as name:
        drive = Drive(Path(name), options)
        try:
            yield from blocks(drive, num_scans, block, options, most_s)
            check(drive, Path(name))
        finally:
            drive.close()


def blocks(
    drive: Drive, num_scans: int, block: int, options: Options, most_s: float
) -> Iterator[Row]:
    """Send all scans; yield a row for every block."""
    start = lap = time.monotonic()
    sent = 0
    for number, turn, place in there_and_back(num_scans, options.scans):
        drive.send(number, turn, place)
        sent = number + 1
        drive.wait_for(sent - UNDER_WAY)
        is_last = sent == num_scans or time.monotonic() - start > most_s
        if sent % block == 0 or is_last:
            drive.wait_for(sent)
            now = time.monotonic()
            yield row(drive, sent, ((sent - 1) % block + 1) / (now - lap))
            lap = now
        if is_last:
            return


def row(drive: Drive, sent: int, rate_hz: float) -> Row:
    """Return the figures of a block."""
    values = drive.values()
    return {
        'scans': sent,
        'rss_MB': drive.resident_bytes() / 2**20,
        'median_ms': float(values['milliseconds.total.median']),
        'p99_ms': float(values['milliseconds.total.p99']),
        'rate_hz': rate_hz,
        'lost': sent - int(values['scans.mapped']),
        'voxels': int(values['voxels']),
    }


def check(drive: Drive, folder: Path) -> None:
    """Compare the map that the node saves with a new map of the clouds of its window."""
    answer = drive.peer.call('save_map')
    if not answer.success:
        raise RuntimeError(answer.message)
    found, window = load_map(folder / MAPS / 'map.npz')
    if rebuilt(found.voxel_size_m, window, drive.latest) != found.digest():
        raise RuntimeError('the map is not the sum of the scans in its window')
    code = drive.node.stop()
    if code or 'Traceback' in drive.node.output:
        raise RuntimeError(f'the node ended with {code}: {drive.node.output[-2000:]}')


def rebuilt(voxel_size_m: float, window: Iterable[Any], latest: Iterable[RawCloud]) -> str:
    """Return the digest of a map made of clouds at the poses of a window."""
    near_m = Config.from_mapping(CONFIG).input.min_range_m
    anew = SurfelMap(voxel_size_m)
    for scan, message in zip(window, latest, strict=True):
        pose = scan.T_map_sensor
        points = to_scan(message).points
        anew.insert(anew.reduce(points, pose, origin=pose[:3, 3], min_range_m=near_m))
    return anew.digest()
