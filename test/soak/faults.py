# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A drive at a fixed rate with random faults between the scans, to watch memory and the map.

Half of the scans are followed by a fault: a damaged cloud, an invalid pose, new frames,
a stamp that is repeated, back or ahead, or a save that fails. In the end the map is compared with
a new map of the scans that were mapped, and the file of the last save that succeeded with
the digest at that time. ``python -m test.soak.faults 10`` drives for ten minutes.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
import contextlib
import errno
import math
import os
from pathlib import Path
import random
import tempfile
import time
from unittest import mock

from scipy.spatial.transform import Rotation

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError, FileFormatError
from surfel_mapper.files.map_state import load_map, save_map
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.messages.pointcloud2 import cloud_bytes, CloudBytes, parse_cloud, to_scan
from surfel_mapper.pipeline import Mapper
from test.bench.machine import resident_bytes
from test.bench.options import Options
from test.bench.report import Row
from test.bench.street import Street
from test.fuzz.mutations import cut, flip, overwrite, randomise
from test.soak.core import BASE, CONFIG, there_and_back, TURN_M
from test.soak.long_run import row_of

RATE_HZ = 20.0
FAULT_SHARE = 0.5
BLOCK = 1000
PERIOD_NS = 50_000_000


class FaultyDrive:
    """A mapper that is driven along a street, with faults on the way."""

    def __init__(self, options: Options, directory: Path, seed: int = 1) -> None:
        street = Street(options)
        street.prepare(options.scans)
        self.poses = [street.pose(number) for number in range(options.scans)]
        self.clouds = [serialised(street, number) for number in range(options.scans)]
        self.mapper = Mapper(Config.from_mapping(CONFIG))
        self.mapper.warm_up()
        self.mapper._drops.is_silent = True
        self.latest: deque = deque(maxlen=self.mapper.config.window.max_scans)
        self.faults: Counter[str] = Counter()
        self.refused = 0
        self.rng = random.Random(seed)
        self.path = directory / 'map.npz'
        self.saved = ''
        self.clouds_sent = 0

    def scan(self, number: int, turn: int, place: int) -> None:
        """Map a scan."""
        stamp_ns = (number + 1) * PERIOD_NS
        xyz = self.poses[place][:3, 3] + TURN_M * turn
        q_xyzw = Rotation.from_matrix(self.poses[place][:3, :3]).as_quat()
        self.mapper.add_pose('odom', BASE, stamp_ns, xyz, q_xyzw)
        self.receive(self.clouds[place], stamp_ns)
        self.insert()

    def receive(self, raw: bytes, stamp_ns: int) -> None:
        """Decode a cloud as the node does; one that is damaged is counted."""
        self.clouds_sent += 1
        stamped = bytearray(raw)
        stamped[4:12] = b''.join(
            part.to_bytes(4, 'little') for part in divmod(max(stamp_ns, 0), 10**9)
        )
        self.decode(bytes(stamped))

    def decode(self, raw: bytes) -> None:
        """Decode a cloud and queue it, or count it as refused."""
        try:
            scan = to_scan(parse_cloud(raw))
        except CloudFormatError as error:
            self.refused += 1
            self.mapper.refuse_clouds('bad_cloud', '/points', str(error))
            return
        self.mapper.add_scan(scan)

    def insert(self) -> None:
        """Map the scans whose poses are there."""
        for update in self.mapper.insert_ready():
            self.latest.append((update.scan.points.copy(), update.T_map_sensor.copy()))

    def fault(self, number: int, place: int) -> None:
        """Inject a random fault."""
        kinds = (self.damaged_cloud, self.bad_pose, self.frames, self.odd_stamp, self.failing_save)
        kind = self.rng.choices(kinds, (8, 4, 4, 4, 1))[0]
        self.faults[kind.__name__] += 1
        kind((number + 1) * PERIOD_NS, place)
        self.insert()

    def damaged_cloud(self, stamp_ns: int, place: int) -> None:
        """Send a cloud with changed bytes in its head, or cut off."""
        data = bytearray(self.clouds[place])
        head, rest = data[:200], data[200:]
        self.rng.choice((flip, overwrite, randomise, cut))(self.rng, head, [bytes(head)])
        self.clouds_sent += 1
        self.decode(bytes(head + rest[: self.rng.choice((0, 1000, len(rest)))]))

    def bad_pose(self, stamp_ns: int, place: int) -> None:
        """Send an invalid pose, or one of another tree."""
        xyz, q_xyzw = self.rng.choice(
            (
                ((math.nan, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
                ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
                ((1e308, 0.0, 0.0), (2.0, 0.0, 0.0, 1.0)),
            )
        )
        self.mapper.add_pose('odom', BASE, stamp_ns, xyz, q_xyzw)
        self.mapper.add_pose(BASE, 'odom', stamp_ns, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))

    def frames(self, stamp_ns: int, place: int) -> None:
        """Send transforms of new frames, some in long chains."""
        names = [f'frame_{self.rng.randrange(10**9)}' for _ in range(100)]
        parents = [*names[:-1], 'odom'] if self.rng.random() < 0.5 else ['tree'] * 100
        for parent, child in zip(parents, [*names[1:], 'last'], strict=True):
            self.mapper.add_pose(parent, child, stamp_ns, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))

    def odd_stamp(self, stamp_ns: int, place: int) -> None:
        """Send a cloud with a stamp that is repeated, back or ahead."""
        steps_s = (0.0, -0.01, -0.5, -100.0, 100.0, 1e9)
        self.receive(self.clouds[place], stamp_ns + round(self.rng.choice(steps_s) * 1e9))

    def failing_save(self, stamp_ns: int, place: int) -> None:
        """Save; a disk that is full ends most attempts."""
        full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        failing = mock.patch(f'os.{self.rng.choice(("fsync", "replace"))}', side_effect=full)
        with failing if self.rng.random() < 0.6 else contextlib.nullcontext():
            try:
                save_map(self.path, self.mapper.map)
            except FileFormatError:
                return
        self.saved = self.mapper.map.digest()

    def check(self) -> None:
        """Raise RuntimeError if a scan is not counted, or the map or the file is another."""
        self.mapper.finish()
        counters = self.mapper.counters
        counted = counters.mapped + counters.gated + sum(counters.dropped.values())
        if not self.clouds_sent == counters.received == counted:
            raise RuntimeError(f'{self.clouds_sent} clouds sent, {counters.summary()["scans"]}')
        anew = SurfelMap(self.mapper.map.voxel_size_m)
        near_m = self.mapper.config.input.min_range_m
        number = len(self.mapper.window)
        for points, pose in list(self.latest)[len(self.latest) - number :]:
            anew.insert(anew.reduce(points, pose, origin=pose[:3, 3], min_range_m=near_m))
        if anew.digest() != self.mapper.map.digest():
            raise RuntimeError('the map is not the sum of the scans in its window')
        if self.saved and load_map(self.path)[0].digest() != self.saved:
            raise RuntimeError('the file is not the map at the last save that succeeded')


def serialised(street: Street, number: int) -> bytes:
    """Return a scan as the bytes of a message."""
    message = street.message(number)
    names = [name for name in CloudBytes.__slots__ if name != 'fields']
    cloud = CloudBytes(
        fields=tuple(message.fields), **{name: getattr(message, name) for name in names}
    )
    return bytes(cloud_bytes(cloud, stamp_ns=0, frame_id=BASE))


def run(
    num_scans: int, options: Options, most_s: float = math.inf, rate_hz: float = RATE_HZ
) -> Iterator[Row]:
    """
    Yield a row for every block of scans, up to a number of scans or a time.

    Raises
    ------
    RuntimeError
        If a scan was not counted, or the map or a file is not as it has to be in the end.

    """
    keep_freed_memory()
    with tempfile.TemporaryDirectory(prefix='surfel_mapper-soak-') as directory:
        drive = FaultyDrive(options, Path(directory))
        start = time.monotonic()
        for number, turn, place in there_and_back(num_scans, options.scans):
            drive.scan(number, turn, place)
            if drive.rng.random() < FAULT_SHARE:
                drive.fault(number, place)
            is_over = time.monotonic() - start > most_s or number + 1 == num_scans
            if (number + 1) % BLOCK == 0 or is_over:
                yield {
                    'scans': number + 1,
                    'rss_MB': resident_bytes() / 2**20,
                    'seconds': time.monotonic() - start,
                    'mapped': drive.mapper.counters.mapped,
                    'refused': drive.refused,
                    'voxels': drive.mapper.map.num_voxels,
                    **drive.faults,
                }
            if is_over:
                break
            time.sleep(max(start + (number + 1) / rate_hz - time.monotonic(), 0.0))
        drive.check()


if __name__ == '__main__':
    import json
    import sys

    rows = []
    for row in run(10**9, Options(scans=300, beams=32, columns=256), 60.0 * float(sys.argv[1])):
        rows.append(row)
        print(json.dumps(row), flush=True)
    result = 'the map equals a new one, the file the map of its time'
    print(row_of(f'-m test.soak.faults {sys.argv[1]}', rows, result))
