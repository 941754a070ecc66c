# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The drive with random faults of faults.py through the node: a process of its own, over DDS.

Scans come at a fixed rate; every second one is followed by a fault: a malformed cloud, points
that are not finite, an invalid pose, new frames, a stamp that is repeated, back or ahead, a clock
that is set back or ahead, a parameter that changes or is refused, a service call, a directory
that cannot be written, an invalid polygon. One layer fails at random and is switched off and on
again. In the end every cloud has to be counted, the map that the node saves has to equal an
offline replay of a bag of the scans in its window, and the last checkpoint has to load.
``python -m test.soak.node_faults 10`` drives for ten minutes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
import json
import math
from pathlib import Path
import random
import sys
import tempfile
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point32, PolygonStamped
from nav_msgs.msg import Odometry
from nav_msgs.srv import LoadMap
import numpy as np
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from scipy.spatial.transform import Rotation
from std_srvs.srv import SetBool, Trigger

from surfel_mapper.bags.writer import BagWriter
from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.files.map_state import load_map
from surfel_mapper.messages.pointcloud2 import parse_cloud, to_scan
from surfel_mapper.offline.replay import replay, ReplayOptions
from test.bench.options import Options
from test.bench.report import Row
from test.bench.street import Street
from test.fuzz.mutations import cut, flip, overwrite, randomise
from test.ros.domain import domain_of_our_own
from test.ros.live import Peer, Process, stamp
from test.soak.core import BASE, CONFIG, there_and_back, TURN_M
from test.soak.faults import FAULT_SHARE, RATE_HZ, serialised
from test.soak.heap import read_heap
from test.soak.long_run import row_of

LAYER = 'test.soak.unreliable_layer'

PERIOD_NS = 50_000_000
FIRST_NS = 1_700_000_000_000_000_000
BLOCK = 1000
WINDOW_SCANS = 300
ANSWER_S = 30.0
"""Longest wait for answers; of requests that wait the middleware keeps ten."""

UNCOUNTED = 2
"""Clouds of a burst whose loss the middleware does not report."""

SETTLED = 25
"""Reports in a row with equal counts, 5 s, after which no cloud is on its way."""

MAPS, CHECKPOINT_S = 'maps', 20.0
SETTINGS = {
    **CONFIG,
    'window.max_scans': WINDOW_SCANS,
    'output.directory': MAPS,
    'output.checkpoint_s': CHECKPOINT_S,
    'publish.diagnostics_rate_hz': 5.0,
    'layers.tsdf.enabled': True,
    'layers.tsdf.voxel_size_m': 0.5,
    'layers.tsdf.truncation_m': 1.5,
    'layers.tsdf.max_range_m': 15.0,
    'layers.unreliable.enabled': True,
    'qos_overrides./points.subscription.depth': 100,
}

PARAMETERS = (
    ('map.min_points', 3),
    ('map.min_points', -1),
    ('window.max_scans', 50),
    ('window.max_scans', WINDOW_SCANS),
    ('window.max_scans', 2**40),
    ('window.max_age_s', math.nan),
    ('window.max_age_s', 'old'),
    ('publish.markers_rate_hz', 5.0),
    ('publish.markers_rate_hz', math.inf),
    ('map.voxel_size_m', 0.1),
    ('filters', '/dev/zero'),
    ('filters', 'missing\n\x1b[31m.yaml'),
    ('output.map_name', '../outside'),
    ('no.such_setting', True),
    ('layers.tsdf.enabled', 7),
)
"""Parameters to set; all but four of them are refused."""

URLS = (
    '',
    'map',
    'missing',
    '/dev/zero',
    '../../etc/passwd',
    'file://host/map',
    'a\0b',
    '%' * 999,
)

BAD_NUMBERS = (math.nan, math.inf, -math.inf, 1e30, -1e38, 5e-324)


def install_layer(folder: Path) -> None:
    """Write the metadata of a package with the layer that fails into a folder of sys.path."""
    info = folder / 'unreliable-1.0.dist-info'
    info.mkdir()
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: unreliable\nVersion: 1.0\n')
    points = f'[surfel_mapper.layers]\nunreliable = {LAYER}\n'
    (info / 'entry_points.txt').write_text(points)


class FaultyNode:
    """A node that is driven along a street, with faults on the way."""

    def __init__(self, options: Options, folder: Path, seed: int = 1) -> None:
        street = Street(options)
        street.prepare(options.scans)
        self.poses = [street.pose(number) for number in range(options.scans)]
        self.clouds = [serialised(street, number) for number in range(options.scans)]
        self.sent: dict[int, tuple[bytes, bytes | int]] = {}
        self.num_clouds = 0
        self.faults: Counter[str] = Counter()
        self.answers: Counter[str] = Counter()
        self.rng, self.folder = random.Random(seed), folder
        install_layer(folder)
        given = [item for k, v in SETTINGS.items() for item in ('-p', f'{k}:={v}')]
        self.node = Process(['node', '--ros-args', *given], folder)
        self.peer = Peer()
        self._reports = self.peer.collect(DiagnosticArray, '/diagnostics', QoSProfile(depth=1))
        self._values: dict[str, str] = {}
        self.peer.spin_until(self.values)
        kinds = {'/surfel_mapper/clear_polygon': PolygonStamped}
        self.peer.advertise('/odom', '/points', depth=100)
        self.peer.advertise(*kinds, kinds=kinds)
        self._parameters = self.peer.parameters()
        self._clients = {
            name: self.peer.client(kind, name)
            for name, kind in (
                ('save_map', Trigger),
                ('align', Trigger),
                ('clear', Trigger),
                ('load_map', LoadMap),
                ('pause', SetBool),
            )
        }
        self._clock_ns = FIRST_NS
        self._paused_until = self._away_until = -1

    def close(self) -> None:
        """Stop the node and the peer."""
        self.peer.close()
        self.node.kill()

    def stamp_ns(self, number: int) -> int:
        """Return the stamp of a scan."""
        return self._clock_ns + number * PERIOD_NS

    def scan(self, number: int, turn: int, place: int) -> None:
        """Send the pose and the cloud of a scan."""
        stamp_ns = self.stamp_ns(number)
        pose = self.pose(stamp_ns, turn, place)
        self.peer.publish('/odom', pose)
        self.cloud(stamp_ns, self.clouds[place], pose, place)

    def pose(self, stamp_ns: int, turn: int, place: int) -> bytes:
        """Return the serialised odometry of a scan."""
        xyz = self.poses[place][:3, 3] + TURN_M * turn
        q_xyzw = Rotation.from_matrix(self.poses[place][:3, :3]).as_quat()
        return odometry(stamp_ns, xyz, q_xyzw)

    def cloud(self, stamp_ns: int, raw: bytes, pose: bytes, place: int | None = None) -> None:
        """Send a cloud, stamped if it is long enough; remember the first of each stamp."""
        self.num_clouds += 1
        message = stamped(raw, stamp_ns)
        self.peer.publish('/points', message)
        if stamp_ns not in self.sent and (place is not None or is_readable(message)):
            self.sent[stamp_ns] = (pose, message if place is None else place)

    def end_faults(self, number: int) -> None:
        """End the faults that last until this scan."""
        if number == self._paused_until:
            self.ask('pause', SetBool.Request(data=False))
        if number == self._away_until:
            (self.folder / MAPS).unlink()
            (self.folder / 'away').rename(self.folder / MAPS)

    def fault(self, number: int, turn: int, place: int) -> None:
        """Inject a random fault."""
        kinds: dict[Callable[[int, int, int], None], int] = {
            self.malformed_cloud: 48,
            self.bad_points: 32,
            self.bad_pose: 24,
            self.new_frames: 24,
            self.odd_stamp: 24,
            self.clock_jump: 1,
            self.parameter: 6,
            self.service: 4,
            self.directory_away: 1,
            self.polygon: 8,
        }
        kind = self.rng.choices([*kinds], [*kinds.values()])[0]
        self.faults[kind.__name__] += 1
        kind(number, turn, place)

    def malformed_cloud(self, number: int, turn: int, place: int) -> None:
        """Send a cloud with changed bytes in its head, or cut off, with a pose of its own."""
        data = bytearray(self.clouds[place])
        head, rest = data[:200], data[200:]
        for _ in range(self.rng.choice((1, 1, 3))):
            self.rng.choice((flip, overwrite, randomise, cut))(self.rng, head, [bytes(head)])
        raw = bytes(head + rest[: self.rng.choice((0, 1000, len(rest)))])
        self.extra(raw, number, turn, place)

    def bad_points(self, number: int, turn: int, place: int) -> None:
        """Send a cloud in which some or all coordinates are not finite, or far too large."""
        data = bytearray(self.clouds[place])
        start = len(data) // 8 * 4
        values = np.frombuffer(data, '<f4', count=(len(data) - start) // 4, offset=start)
        share = self.rng.choice((0.01, 0.5, 1.0))
        chosen = np.random.default_rng(number).random(len(values)) < share
        values[chosen] = self.rng.choice(BAD_NUMBERS)
        self.extra(bytes(data), number, turn, place)

    def extra(self, raw: bytes, number: int, turn: int, place: int) -> None:
        """Send a cloud between two scans, with its pose."""
        stamp_ns = self.stamp_ns(number) + PERIOD_NS // 2
        pose = self.pose(stamp_ns, turn, place)
        self.peer.publish('/odom', pose)
        self.cloud(stamp_ns, raw, pose)

    def bad_pose(self, number: int, turn: int, place: int) -> None:
        """Send an invalid pose, one of another tree, or damaged bytes."""
        stamp_ns = self.stamp_ns(number) + PERIOD_NS // 2
        none = (0.0, 0.0, 0.0, 1.0)
        messages = (
            odometry(stamp_ns, (math.nan, 0.0, 0.0), none),
            odometry(stamp_ns, (0.0, 0.0, 0.0), (0.0,) * 4),
            odometry(stamp_ns, (1e308, 0.0, 0.0), (2.0, 0.0, 0.0, 1.0)),
            odometry(stamp_ns, (0.0, 0.0, 0.0), none, parent=BASE, child='odom'),
            odometry(stamp_ns, (0.0, 0.0, 0.0), none)[: self.rng.randrange(4, 700)],
        )
        self.peer.publish('/odom', self.rng.choice(messages))

    def new_frames(self, number: int, turn: int, place: int) -> None:
        """Send transforms of new frames, and a cloud of one of them."""
        stamp_ns = self.stamp_ns(number)
        names = [f'frame_{self.rng.randrange(10**9)}' for _ in range(20)]
        for parent, child in zip(['tree', *names], names, strict=False):
            message = odometry(stamp_ns, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), parent, child)
            self.peer.publish('/odom', message)

    def odd_stamp(self, number: int, turn: int, place: int) -> None:
        """Send a cloud with a stamp that is repeated, back or ahead, without a pose."""
        step_s = self.rng.choice((0.0, -0.01, -0.5, 100.0, 4e8, -1.7e9))
        stamp_ns = self.stamp_ns(number) + round(step_s * 1e9)
        self.num_clouds += 1
        self.peer.publish('/points', stamped(self.clouds[place], stamp_ns))

    def clock_jump(self, number: int, turn: int, place: int) -> None:
        """Set the clock back or ahead from now on; the map is cleared at every time back."""
        seconds = self.rng.choice((-3600.0, -100.0, 100.0, 3600.0))
        self._clock_ns += round(seconds * 1e9) + self.rng.randrange(10**6)

    def parameter(self, number: int, turn: int, place: int) -> None:
        """Change a parameter, or try to."""
        name, value = self.rng.choice(PARAMETERS)
        future = self._parameters.set_parameters([Parameter(name, value=value)])

        def count(done: Any) -> None:
            taken = all(result.successful for result in done.result().results)
            self.answers[f'set_parameters {"taken" if taken else "refused"}'] += 1

        self.answers['set_parameters asked'] += 1
        future.add_done_callback(count)

    def service(self, number: int, turn: int, place: int) -> None:
        """Call a service."""
        name = self.rng.choices(
            ('save_map', 'align', 'load_map', 'pause', 'clear'), (5, 4, 5, 2, 1)
        )
        request = None
        if name == ['load_map']:
            request = LoadMap.Request(map_url=self.rng.choice(URLS).replace('\0', ''))
        elif name == ['pause']:
            request, self._paused_until = SetBool.Request(data=True), number + 5
        self.ask(name[0], request)

    def ask(self, name: str, request: Any = None) -> None:
        """Call a service, and count its answer when it comes."""

        def count(done: Any) -> None:
            answer = done.result()
            done_well = getattr(answer, 'success', None)
            if done_well is None:
                done_well = answer.result == LoadMap.Response.RESULT_SUCCESS
            self.answers[f'{name} {"done" if done_well else "refused"}'] += 1

        client = self._clients[name]
        self.answers[f'{name} asked'] += 1
        client.call_async(request or client.srv_type.Request()).add_done_callback(count)

    def directory_away(self, number: int, turn: int, place: int) -> None:
        """Put a file in place of the directory of maps for half a second; save meanwhile."""
        maps = self.folder / MAPS
        if maps.is_dir() and number > self._away_until:
            maps.rename(self.folder / 'away')
            maps.write_bytes(b'not a directory')
            self._away_until = number + 10
        self.ask('save_map')

    def polygon(self, number: int, turn: int, place: int) -> None:
        """Send an invalid polygon."""
        message = PolygonStamped()
        message.header.frame_id = 'odom'
        corners = self.rng.choice((0, 2, 3, 10_001))
        message.polygon.points = [Point32(x=math.nan) for _ in range(corners)]
        self.peer.publish('/surfel_mapper/clear_polygon', message)

    def values(self) -> dict[str, str]:
        """Return the newest diagnostics; while the mapping thread is busy there are none."""
        for report in self._reports:
            found = {item.key: item.value for item in report.status[0].values}
            if 'scans.received' in found:
                self._values = found
        self._reports.clear()
        return self._values

    def memory(self, key: str) -> float:
        """Return the resident memory of the node, MB: VmRSS, or its peak, VmHWM."""
        text = Path(f'/proc/{self.node._process.pid}/status').read_text(encoding='ascii')
        (line,) = (line for line in text.splitlines() if line.startswith(key))
        return int(line.split()[1]) / 1024

    def settle(self) -> dict[str, str]:
        """Return the counters once they stand still; calls have had time to be answered."""
        end_s = time.monotonic() + ANSWER_S
        self.peer.spin_until(lambda: not self.unanswered() or time.monotonic() > end_s)
        values: list[dict[str, str]] = []

        def is_settled() -> bool:
            if self._reports:
                values.append(self.values())
            same = [found['scans.received'] for found in values[-SETTLED:]]
            return len(same) == SETTLED and len(set(same)) == 1

        self.peer.spin_until(is_settled)
        return values[-1]

    def unanswered(self) -> dict[str, int]:
        """Return how many calls of each service have no answer."""
        asked = {key[:-6]: num for key, num in self.answers.items() if key.endswith(' asked')}
        ends = (' done', ' taken', ' refused')
        left = {
            name: number - sum(self.answers[name + end] for end in ends)
            for name, number in asked.items()
        }
        return {name: number for name, number in left.items() if number}

    def check(self) -> Row:
        """Return the figures; raise RuntimeError if a cloud, the map or a file is not right."""
        self.ask('pause', SetBool.Request(data=False))
        if (self.folder / 'away').exists():
            (self.folder / MAPS).unlink()
            (self.folder / 'away').rename(self.folder / MAPS)
        values = self.settle()
        dropped = {
            key.removeprefix('scans.dropped.'): int(value)
            for key, value in values.items()
            if key.startswith('scans.dropped.')
        }
        received, mapped = int(values['scans.received']), int(values['scans.mapped'])
        counts = {
            'sent': self.num_clouds,
            'received': received,
            'clouds_lost': int(values['clouds_lost']),
            'mapped': mapped,
            'waiting': int(values['waiting']),
            'resets': int(values['resets']),
            'dropped': dropped,
            'ignored': {k: v for k, v in values.items() if k.startswith('messages_ignored.')},
            'answers': dict(self.answers),
            'unanswered': self.unanswered(),
        }
        if received != mapped + sum(dropped.values()) + counts['waiting']:
            raise RuntimeError(f'a cloud is not counted: {counts}')
        counts['lost_uncounted'] = self.num_clouds - received - counts['clouds_lost']
        if not 0 <= counts['lost_uncounted'] <= UNCOUNTED * (1 + counts['clouds_lost']):
            raise RuntimeError(f'a cloud vanished: {counts}')
        answer = self.peer.call('save_map')
        if not answer.success:
            raise RuntimeError(answer.message)
        found, window = load_map(self.folder / MAPS / 'map.npz')
        counts['window'] = len(window)
        self.compare(found.digest(), [scan.stamp_ns for scan in window])
        checkpoints = sorted((self.folder / MAPS).glob('map.checkpoint.?.npz'))
        counts['checkpoints'] = [load_map(path)[0].num_voxels for path in checkpoints]
        code = self.node.stop()
        if code or 'Traceback' in self.node.output:
            raise RuntimeError(f'the node ended with {code}: {self.node.output[-2000:]}')
        return counts

    def compare(self, digest: str, stamps: list[int]) -> None:
        """Raise RuntimeError if an offline replay of the scans of a window has another digest."""
        bag = self.folder / 'window'
        with BagWriter(bag) as writer:
            for stamp_ns in stamps:
                pose, cloud = self.sent[stamp_ns]
                raw = cloud if isinstance(cloud, bytes) else stamped(self.clouds[cloud], stamp_ns)
                writer.write('/odom', 'nav_msgs/msg/Odometry', stamp_ns, pose)
                writer.write('/points', 'sensor_msgs/msg/PointCloud2', stamp_ns, raw)
        config = Config.from_mapping({**CONFIG, 'window.max_scans': WINDOW_SCANS})
        options = ReplayOptions(formats=('npz',))
        result = replay(bag, config=config, output=self.folder / 'replayed', options=options)
        if result.mapper.counters.mapped != len(stamps):
            raise RuntimeError(f'{len(stamps)} scans in the window: {result.summary["scans"]}')
        if result.mapper.map.digest() != digest:
            raise RuntimeError('the map of the node is not that of a replay of its scans')


def odometry(
    stamp_ns: int, xyz: Any, q_xyzw: Any, parent: str = 'odom', child: str = BASE
) -> bytes:
    """Return a serialised nav_msgs/Odometry."""
    message = Odometry(child_frame_id=child)
    message.header.frame_id = parent
    stamp(message, stamp_ns)
    at, turned = message.pose.pose.position, message.pose.pose.orientation
    at.x, at.y, at.z = (float(value) for value in xyz)
    turned.x, turned.y, turned.z, turned.w = (float(value) for value in q_xyzw)
    return serialize_message(message)


def stamped(raw: bytes, stamp_ns: int) -> bytes:
    """Return a serialised message with another stamp, if it has one."""
    parts = (part.to_bytes(4, 'little', signed=True) for part in divmod(stamp_ns, 10**9))
    return raw[:4] + b''.join(parts) + raw[12:] if len(raw) >= 12 else raw


def is_readable(raw: bytes) -> bool:
    """Return whether a cloud can be decoded."""
    try:
        to_scan(parse_cloud(raw))
    except CloudFormatError:
        return False
    return True


def run(
    num_scans: int, options: Options, most_s: float = math.inf, rate_hz: float = RATE_HZ
) -> Iterator[Row]:
    """
    Yield a row for every block of scans, up to a number of scans or a time, and the verdict.

    Raises
    ------
    RuntimeError
        If a cloud was not counted, a call not answered, the node printed a traceback, or the map
        or a checkpoint is not as it has to be in the end.

    """
    with tempfile.TemporaryDirectory(prefix='surfel_mapper-soak-') as name:
        drive = FaultyNode(options, Path(name))
        try:
            start = time.monotonic()
            for number, turn, place in there_and_back(num_scans, options.scans):
                drive.end_faults(number)
                drive.scan(number, turn, place)
                if drive.rng.random() < FAULT_SHARE:
                    drive.fault(number, turn, place)
                is_over = time.monotonic() - start > most_s or number + 1 == num_scans
                if (number + 1) % BLOCK == 0 or is_over:
                    yield block(drive, number + 1, time.monotonic() - start)
                if is_over:
                    break
                drive.peer.spin_for(max(start + (number + 1) / rate_hz - time.monotonic(), 0.0))
            yield drive.check()
        finally:
            drive.close()


def block(drive: FaultyNode, num_scans: int, seconds: float) -> Row:
    """Return the figures of a block."""
    values = drive.values()
    return {
        'scans': num_scans,
        'seconds': seconds,
        'rss_MB': drive.memory('VmRSS'),
        'peak_MB': drive.memory('VmHWM'),
        **read_heap(drive.folder),
        'mapped': int(values['scans.mapped']),
        'window': int(values['window_scans']),
        'voxels': int(values['voxels']),
        'median_ms': float(values['milliseconds.total.median']),
        'p99_ms': float(values['milliseconds.total.p99']),
        'stages_ms': {
            key.split('.')[1]: float(value)
            for key, value in values.items()
            if key.startswith('milliseconds.') and key.endswith('.median')
        },
        'layers_off': 'layers_off.unreliable' in values,
        **drive.faults,
    }


if __name__ == '__main__':
    length = Options(scans=300, beams=32, columns=256)
    with domain_of_our_own():
        rows = []
        for row in run(10**9, length, 60.0 * float(sys.argv[1])):
            rows.append(row)
            print(json.dumps(row), flush=True)
    result = 'every cloud counted, the map equals an offline replay of its scans'
    print(row_of(f'-m test.soak.node_faults {sys.argv[1]}', rows, result))
