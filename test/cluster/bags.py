# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Small bags with difficult borders between shards, and their maps by one process."""

from __future__ import annotations

from surfel_mapper.cluster.shards import cut
from surfel_mapper.config import Config
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.replay import all_scans
from surfel_mapper.offline.request import Request
from surfel_mapper.pipeline import Mapper
from test.bags.recorded import drive, START_NS, write_rosbag2

NUM_SCANS = 60
RECORDED_S = 5.9


def plain():
    """Return 5.9 s of a drive at 10 Hz."""
    return drive(num_scans=NUM_SCANS)


def late_poses():
    """Return a drive whose poses are recorded 0.25 s after the scans that they belong to."""
    return shifted(plain(), lambda topic: 250_000_000 if topic == '/tf' else 0)


def slow_transforms():
    """Return a drive in a map frame, whose place in odom comes every 4 s, one in advance."""
    entries = plain()
    steps = range(-1, 3)
    for step in steps:
        stamp_ns = START_NS + step * 4 * 10**9
        entries.transform('/tf', stamp_ns, 'map', 'odom', (0.1 * step, 0.0, 0.0))
        topic, type_, record_ns, message = entries.pop()
        record_ns = max(record_ns - 4 * 10**9, START_NS)
        entries.append((topic, type_, record_ns, message))
    entries.sort(key=lambda entry: entry[2])
    return entries


def with_faults():
    """Return a drive with repeated and late stamps, without some poses, and with bad clouds."""
    entries = plain()
    clouds = [n for n, entry in enumerate(entries) if entry[0] == '/points']
    for number in clouds[10::7]:
        entries[number][3].point_step = 15
    for number in clouds[12::9]:
        stamp = entries[number][3].header.stamp
        stamp_ns = stamp.sec * 10**9 + stamp.nanosec - (100 if number % 2 else 130) * 10**6
        stamp.sec, stamp.nanosec = divmod(stamp_ns, 10**9)
    gone = {n for n, entry in enumerate(entries) if entry[0] == '/tf' and n % 5 == 0}
    kept = type(entries)()
    kept.extend(entry for n, entry in enumerate(entries) if n not in gone or n < 3)
    return kept


def time_set_back():
    """Return a drive in which time goes back by 3 s after 4 s."""
    entries = plain()
    for topic, _, record_ns, message in entries:
        if record_ns >= START_NS + 4 * 10**9 and topic in ('/points', '/tf'):
            header = message.header if topic == '/points' else message.transforms[0].header
            header.stamp.sec -= 3
    return entries


def shifted(entries, delay_ns):
    """Return messages recorded later, by topic."""
    moved = type(entries)()
    moved.extend((t, k, record_ns + delay_ns(t), m) for t, k, record_ns, m in entries)
    moved.sort(key=lambda entry: entry[2])
    return moved


BAGS = {
    'plain': (plain, {}),
    'odometry': (plain, {'pose.source': 'odometry'}),
    'identity': (plain, {'pose.source': 'identity', 'frames.fixed': 'lidar'}),
    'late poses': (late_poses, {}),
    'slow transforms': (
        slow_transforms,
        {'frames.fixed': 'map', 'pose.max_wait_s': 9.0, 'pose.max_waiting_scans': 100},
    ),
    'faults': (with_faults, {}),
    'time set back': (time_set_back, {}),
    'gate': (plain, {'window.gate_distance_m': 0.8}),
}
"""Bags by the difficulty at their borders, and settings."""


def written(path, name):
    """Write a bag, and return its path and settings."""
    make, settings = BAGS[name]
    return write_rosbag2(path / name.replace(' ', '_'), make()), Config().replace(settings)


def request(bag, config, **part):
    """Return the request for a bag of recorded.py."""
    pose_topic = '/tf' if config.pose.source == 'tf' else None
    return Request(path=bag, topics=('/points',), pose_topic=pose_topic, **part)


def shards_of(bag, config, shard_s, **part):
    """Return the shards of a bag of recorded.py."""
    return cut(request(bag, config, **part), config, shard_s)


def in_one_go(bag, config, **part):
    """Return the mapper that has mapped a whole bag, all scans kept."""
    with open_recording(request(bag, config, **part), config.replace(all_scans())) as recording:
        mapper = Mapper(recording.config)
        for _ in recording.replay(mapper):
            pass
    return mapper


def counted(summary):
    """Return the counts of a summary that must not depend on the cuts of bags."""
    return {
        name: value
        if not isinstance(value, dict)
        else {k: v for k, v in value.items() if v and not isinstance(v, dict)}
        for name, value in summary.items()
        if name in ('scans', 'points', 'points_left_out', 'messages_ignored')
    }
