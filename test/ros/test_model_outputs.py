# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The model topics of a node, received over DDS.

Expected values come from a mapper without ROS for the same messages, and from the scene.

(Longer than other files: all topics show the models of one drive.)
"""

from __future__ import annotations

from geometry_msgs.msg import PolygonInstanceStamped
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray
from visualization_msgs.msg import Marker, MarkerArray

from surfel_mapper import Mapper, ModelsMirror
from surfel_mapper.config import Config
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.models.multi_model import MultiModel, Surface
from test.messages.pose_messages import poses_in
from test.ros.live import cloud, LATCHED, NODE, odometry, RVIZ, START_NS

ALL_OUTLINES = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SETTINGS = {
    'pose.source': 'odometry',
    'frames.base_to_sensor': [0.1, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0],
    'window.max_scans': 2,
    'layers.models.enabled': True,
    'layers.models.extract_period_s': 0.0,
    'publish.diagnostics_rate_hz': 20.0,
}
ALL_MODELS = QoSProfile(depth=20, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PERIOD_NS = 100_000_000
TOPICS = {
    'planes': (MarkerArray, LATCHED),
    'primitives': (PointCloud2, LATCHED),
    'surfel_primitives': (PointCloud2, LATCHED),
    'outlines': (PolygonInstanceStamped, ALL_OUTLINES),
}
FLOOR_Z, WALL_Y, PILLAR = -0.9, 3.2, (-2.0, -1.5)


def scene(seed, *, wall=True):
    """Return points on a floor with a hole of 2 m by 2 m, on a wall, on a pillar and in a bush."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform((-4.0, -4.0, FLOOR_Z), (4.0, 3.0, FLOOR_Z), (12_000, 3))
    floor = floor[(np.abs(floor[:, :2] - [1.5, 0.5]) > 1.0).any(axis=1)]
    upright = rng.uniform((-4.0, WALL_Y, -0.4), (4.0, WALL_Y, 2.4), (5000 * wall, 3))
    turn = rng.uniform(0.0, 2.0 * np.pi, 9000)
    pillar = np.stack([1.5 * np.cos(turn), 1.5 * np.sin(turn), rng.uniform(-0.5, 2.4, 9000)], 1)
    bush = rng.uniform((3.0, -3.6, 0.1), (3.4, -3.1, 1.4), (600, 3))
    return np.concatenate([floor, upright, np.array([*PILLAR, 0.0]) + pillar, bush])


def drive(*walls):
    """Return clouds of a sensor at rest, with poses; ``walls``: whether each has the wall."""
    stamps = [START_NS + k * PERIOD_NS for k in range(len(walls))]
    return [
        (cloud(stamp_ns, scene(k, wall=wall)), odometry(stamp_ns, (0.0, 0.0, 0.0)))
        for k, (stamp_ns, wall) in enumerate(zip(stamps, walls, strict=True))
    ]


def start_node(start, peer):
    pairs = [('-p', f'{name}:={str(value).lower()}') for name, value in SETTINGS.items()]
    start('node', '--ros-args', *(item for pair in pairs for item in pair))
    peer.advertise('/odom', '/points')


def send(peer, messages):
    for points, pose in messages:
        peer.publish('/odom', pose)
        peer.publish('/points', points)


def models_of(messages):
    """Return the models of a mapper without ROS after the same messages."""
    mapper = Mapper(Config.from_mapping(SETTINGS))
    for points, pose in messages:
        for found in poses_in('odometry', pose, 'base_link'):
            mapper.add_pose(*found)
        mapper.add_scan(to_scan(points))
        list(mapper.insert_ready())
    return mapper.models


def stamp_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


class Picture:
    """The markers that a viewer shows after some messages."""

    def __init__(self, messages):
        self.shown = {}
        for message in messages:
            for marker in message.markers:
                if marker.action == Marker.DELETEALL:
                    self.shown.clear()
                elif marker.action == Marker.DELETE:
                    self.shown.pop((marker.ns, marker.id), None)
                else:
                    self.shown[marker.ns, marker.id] = marker

    def ids(self, ns):
        return sorted(number for name, number in self.shown if name == ns)

    def area(self, ns, number):
        a, b, c = points_of(self.shown[ns, number].points).reshape(-1, 3, 3).transpose(1, 0, 2)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def points_of(points):
    return np.array([(p.x, p.y, p.z) for p in points]).reshape(-1, 3)


def ring_area(ring, normal):
    """Return the area of a ring (M, 3) about a normal, without its holes."""
    after = np.roll(ring, -1, axis=0)
    return 0.5 * float(np.cross(ring, after).sum(axis=0) @ normal)


def collect(peer, qos=None):
    return {
        name: peer.collect(kind, f'{NODE}/{name}', qos or usual)
        for name, (kind, usual) in TOPICS.items()
    }


def wait_for(peer, found, stamp_ns, names=TOPICS):
    """Spin until the newest message of each topic has a stamp."""

    def stamps():
        return {
            name: stamp_of(found[name][-1].markers[-1] if name == 'planes' else found[name][-1])
            for name in names
            if found[name]
        }

    peer.spin_until(
        lambda: len(stamps()) == len(names) and min(stamps().values()) >= stamp_ns,
        what=lambda: f'{stamps()}, expected {stamp_ns}',
    )


def wait_for_outlines(peer, found, ids):
    """Spin until the outlines have these ids; each comes in a message of its own."""
    peer.spin_until(
        lambda: sorted(outlines_in(found['outlines'])) == ids,
        what=lambda: f'{sorted(outlines_in(found["outlines"]))}, expected {ids}',
    )
    peer.call('publish_normals')  # answered after everything of the last scan is published
    peer.spin_for(0.3)


def outlines_in(messages):
    """Return the outlines that a client has after some messages, by id."""
    known = {}
    for message in messages:
        ring = points_of(message.polygon.polygon.points)
        known.pop(message.polygon.id, None)
        if len(ring):
            known[message.polygon.id] = ring
    return known


def test_published_models_equal_those_of_a_mapper_without_ros(start, peer):
    start_node(start, peer)
    found = collect(peer)
    messages = drive(True, True, True)
    send(peer, messages)
    wait_for(peer, found, START_NS + 2 * PERIOD_NS)
    models = models_of(messages)
    model = models.model
    assert len(model.planes) >= 2
    assert model.surfaces
    assert len(model.gaussians)
    wait_for_outlines(peer, found, sorted(patch.id for patch in model.patches))

    check_primitives(to_scan(found['primitives'][-1]), model, models.versions)
    check_picture(Picture(found['planes']), model)
    check_outlines(outlines_in(found['outlines']), Picture(found['planes']), model)
    check_surfels(to_scan(found['surfel_primitives'][-1]), models)
    assert {m.header.frame_id for name in ('primitives', 'outlines') for m in found[name]} == {
        'odom'
    }


def check_primitives(rows, model, versions):
    column = rows.columns
    ids = [*(patch.id for patch in model.patches), *model.gaussians.id.tolist()]
    assert column['id'].tolist() == ids
    assert column['version'].tolist() == [versions[number] for number in ids]
    kinds = [0] * len(model.planes) + [1] * len(model.surfaces) + [2] * len(model.gaussians)
    assert column['kind'].tolist() == kinds
    means = rows.points[len(model.patches) :]
    assert means == pytest.approx(model.gaussians.mean, abs=1e-5)
    floor = np.argmax(column['num_points'])
    sensor_z = 0.5  # on the robot
    assert column['d'][floor] == pytest.approx(-FLOOR_Z - sensor_z, abs=1e-5)
    # 8 m by 7 m less 2 m by 2 m; voxels of 0.5 m at the rim count as far as points are in them
    assert column['area'][floor] == pytest.approx(52.0, abs=0.25 * (30.0 + 8.0))
    # the box lies around that, turned as the points are spread
    thickness, width, length = sorted(column[f'extent_{axis}'][floor] for axis in 'xyz')
    assert thickness == 0.0
    assert 6.7 < width <= length < np.hypot(7.0, 8.0) + 0.5
    assert rows.points[floor] == pytest.approx([0.1, -0.5, FLOOR_Z + sensor_z], abs=0.3)


def check_picture(picture, model):
    assert picture.ids('planes') == sorted(plane.id for plane in model.planes)
    assert picture.ids('surfaces') == sorted(surface.id for surface in model.surfaces)
    patches = sorted(patch.id for patch in model.patches)
    assert picture.ids('ids') == picture.ids('outlines') == patches
    assert picture.ids('gaussians') == [0]


def check_outlines(outlines, picture, model):
    assert sorted(outlines) == sorted(patch.id for patch in model.patches)
    for patch in model.patches:
        if not isinstance(patch, Surface):
            area = ring_area(outlines[patch.id], patch.normal)
            assert area == pytest.approx(picture.area('planes', patch.id), rel=1e-3)


def check_surfels(rows, models):
    surfels, labels = models.surfels, models.model.labels
    assert len(rows) == len(labels) == len(surfels)
    assert np.array_equal(rows.columns['primitive'], labels)
    assert np.array_equal(rows.points, surfels.position.astype(np.float32))
    gaussian = np.isin(labels, models.model.gaussians.id)
    assert np.array_equal(rows.columns['kind'] == 2, gaussian)
    assert np.array_equal(rows.columns['kind'] == 255, labels == -1)


def mirrored(messages):
    """Return the copy that a client has after some messages on ~/models."""
    mirror = ModelsMirror()
    for message in list(messages):
        mirror.update(message)
    return mirror


def wait_for_mirror(peer, received, models):
    """Spin until a client has a copy of models; check that it is exact."""
    packed = models.model.to_bytes(models.versions)
    versions = models.versions
    peer.spin_until(
        lambda: mirrored(received).is_complete and mirrored(received).versions == versions,
        what=lambda: f'{len(received)} messages, versions {mirrored(received).versions}',
    )
    mirror = mirrored(received)
    assert mirror.model.to_bytes(mirror.versions) == packed
    again = MultiModel.from_bytes(packed)
    assert (mirror.model.resample(0.1) == again.resample(0.1)).all()


def test_a_mirror_has_the_models_of_the_node_also_if_it_comes_late(start, peer):
    start_node(start, peer)
    early = peer.collect(UInt8MultiArray, f'{NODE}/models', ALL_MODELS)
    messages = drive(True, True, False, False)
    send(peer, messages[:2])
    wait_for_mirror(peer, early, models_of(messages[:2]))
    late = peer.collect(UInt8MultiArray, f'{NODE}/models', RVIZ)
    wait_for_mirror(peer, late, models_of(messages[:2]))
    send(peer, messages[2:])  # the scans with the wall leave the window
    for received in (early, late):
        wait_for_mirror(peer, received, models_of(messages))


def test_removed_models_are_deleted(start, peer):
    start_node(start, peer)
    found = collect(peer)
    messages = drive(True, True, False, False)
    send(peer, messages[:2])
    wait_for(peer, found, START_NS + PERIOD_NS)
    (wall,) = [p.id for p in models_of(messages[:2]).model.planes if abs(p.normal[1]) > 0.9]
    assert wall in Picture(found['planes']).ids('planes')
    peer.spin_until(lambda: wall in outlines_in(found['outlines']))
    send(peer, messages[2:])  # the scans with the wall leave the window
    wait_for(peer, found, START_NS + 3 * PERIOD_NS, ('planes', 'primitives'))
    left = sorted(patch.id for patch in models_of(messages).model.patches)
    assert wall not in left
    picture = Picture(found['planes'])
    assert sorted(picture.ids('planes') + picture.ids('surfaces')) == left
    assert picture.ids('outlines') == picture.ids('ids') == left
    wait_for_outlines(peer, found, left)
    assert wall not in to_scan(found['primitives'][-1]).columns['id']
    peer.call('clear')
    peer.spin_until(lambda: not Picture(found['planes']).shown)
    peer.spin_until(lambda: not outlines_in(found['outlines']))
    peer.spin_until(lambda: found['primitives'][-1].width == 0)


def test_a_late_subscriber_gets_everything_without_another_scan(start, peer):
    start_node(start, peer)
    messages = drive(True, True)
    send(peer, messages)
    peer.diagnosis({'scans.mapped': 2})
    expected = sorted(patch.id for patch in models_of(messages).model.patches)
    for qos in (None, RVIZ, None):  # latched and volatile ones, the last while others read
        found = collect(peer, qos)
        wait_for(peer, found, START_NS + PERIOD_NS)
        picture = Picture(found['planes'])
        assert sorted(picture.ids('planes') + picture.ids('surfaces')) == expected
        wait_for_outlines(peer, found, expected)
        assert expected == to_scan(found['primitives'][-1]).columns['id'][: len(expected)].tolist()
