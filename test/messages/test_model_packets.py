# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of models that change, read by rosbags, and a ModelsMirror that follows them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import get_typestore, Stores

from surfel_mapper import ModelsMirror
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.messages.model_packets import byte_array, COMPLETE_EVERY, ModelStream
from surfel_mapper.models import MultiModel
from surfel_mapper.models.live import LiveModels
from test.models.live_scenes import SETTINGS
from test.models.scenes import sheet

ROS2 = get_typestore(Stores.ROS2_JAZZY)
TYPE = 'std_msgs/msg/UInt8MultiArray'
VOXEL_M = 0.12
ORIGIN = (0.0, 0.0, 5.0)


def received(message):
    """Return a message as rosbags reads it."""
    return ROS2.deserialize_cdr(message, TYPE)


class Robot:
    """A map whose window holds three scans: a floor, a wall that ends, and a bush."""

    def __init__(self):
        self.map = SurfelMap(VOXEL_M)
        self.models = LiveModels(SETTINGS, self.map)
        self.stream = ModelStream()
        self.window = []

    def scan(self, number):
        """Map a scan; return the message of the changes, as a client receives it."""
        rng = np.random.default_rng(number)
        floor = sheet(4.0, 3.0, 0.04, centre=(0.3 * number, 0.0, 0.05), sigma=0.003)
        wall = sheet(2.0, 3.0, 0.04, (1.0, 0.0, 0.0), (1.55, 0.0, 1.2 + number % 3))
        bush = rng.uniform((0.0, 2.0, 0.5), (0.5, 2.5, 1.2), (400, 3))
        walls = [wall] if number % 4 else []
        self.window.append(self.map.add(np.concatenate([floor, bush, *walls]), origin=ORIGIN))
        if len(self.window) > 3:
            self.map.remove(self.window.pop(0))
        return self.follow(number)

    def follow(self, number):
        self.models.update()
        facts = {'stamp_ns': number + 1, 'frame_id': 'odom'}
        message = self.stream.changes(self.models.model, self.models.versions, **facts)
        return message and received(message)

    def full(self):
        return received(self.stream.complete(self.models.model, self.models.versions))

    def content(self):
        """Return the bytes of a file of the present models."""
        return self.models.model.to_bytes(self.models.versions)


def assert_equal(mirror, robot):
    expected = MultiModel.from_bytes(robot.content())
    assert mirror.is_complete
    assert mirror.versions == robot.models.versions
    assert (mirror.model.resample(0.05) == expected.resample(0.05)).all()
    fewer = mirror.model.to_bytes(mirror.versions)
    assert fewer == robot.content()


def test_a_mirror_follows_models_that_come_change_and_go():
    robot, mirror, sizes = Robot(), ModelsMirror(), []
    for number in range(12):
        message = robot.scan(number)
        mirror.update(message)
        assert_equal(mirror, robot)
        assert mirror.stamp_ns == number + 1
        sizes.append(len(message.data))
    robot.map.clear()
    mirror.update(robot.follow(12))
    assert_equal(mirror, robot)
    assert mirror.model.patches == []
    assert robot.follow(13) is None


def test_a_message_of_changes_is_smaller_than_one_of_all():
    robot = Robot()
    for number in range(6):
        robot.scan(number)
    few = SurfelMap(VOXEL_M)
    points = np.random.default_rng(0).uniform((8.0, 8.0, 0.0), (9.0, 9.0, 1.0), (300, 3))
    robot.map.insert(few.add(points, origin=ORIGIN))
    assert len(robot.follow(6).data) < 0.5 * len(robot.full().data)


def test_a_late_client_is_complete_after_a_complete_message():
    robot, mirror = Robot(), ModelsMirror()
    for number in range(3):
        message = robot.scan(number)
    mirror.update(message)
    assert not mirror.is_complete
    assert mirror.model is None
    mirror.update(robot.full())
    assert_equal(mirror, robot)
    mirror.update(robot.scan(3))
    assert_equal(mirror, robot)


def test_a_lost_message_is_noticed_and_repaired():
    robot, mirror = Robot(), ModelsMirror()
    states = []
    for number in range(COMPLETE_EVERY + 1):
        message = robot.scan(number)
        if number != 4:
            mirror.update(message)
            states.append(mirror.is_complete)
    assert states == [True] * 4 + [False] * (COMPLETE_EVERY - 5) + [True]
    assert_equal(mirror, robot)


def test_a_node_that_starts_again_is_followed():
    mirror = ModelsMirror()
    for robot in (Robot(), Robot()):
        for number in range(3):
            mirror.update(robot.scan(number))
            assert_equal(mirror, robot)


def test_the_array_has_one_dimension_and_no_offset():
    message = received(byte_array(b'abc'))
    (dimension,) = message.layout.dim
    assert (dimension.label, dimension.size, dimension.stride) == ('surfel_mapper models', 3, 3)
    assert (message.layout.data_offset, bytes(message.data)) == (0, b'abc')


def test_bytes_that_are_no_models_leave_the_copy_as_it_is():
    robot, mirror = Robot(), ModelsMirror()
    mirror.update(robot.scan(0))
    damaged = bytearray(robot.full().data)
    damaged[100] ^= 1
    for data in (b'', b'anything', bytes(damaged)):
        with pytest.raises(CloudFormatError, match='surfel_mapper models: '):
            mirror.update(SimpleNamespace(data=data))
    assert_equal(mirror, robot)
