# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Publish clouds as an ordinary driver does: rclpy and its defaults, nothing of this package.

``python plain_publisher.py reliable|best_effort NUMBER FIRST_STAMP_NS cloud|depth`` publishes,
once the topic has a subscriber, NUMBER messages at 10 Hz for each size in bytes read from stdin,
and confirms each size on stdout. Depth images have 640 pixels of 16 bits a row, and each comes
with its camera info. A reliable publisher waits until the messages that it keeps have arrived,
as on a loaded machine its queue overflows.
"""

from array import array
import sys
import time

from lifecycle_msgs.srv import GetState
import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField

COLUMNS = 640
"""Width of images."""

DEPTH = 10

LONGEST_WAIT = Duration(seconds=20)

POINT_STEP = 160
"""Bytes per point, so that mapping is cheap compared with sending."""


def cloud(stamp_ns: int, num_bytes: int) -> PointCloud2:
    """Return a cloud of a flat floor."""
    num = num_bytes // POINT_STEP
    points = bytearray(num * POINT_STEP)
    floats = memoryview(points).cast('f')
    for number in range(num):
        floats[40 * number] = (number % 200) * 0.05
        floats[40 * number + 1] = (number // 200) * 0.05
    message = PointCloud2(height=1, width=num, point_step=POINT_STEP, row_step=len(points))
    message.fields = [
        PointField(name=name, offset=4 * axis, datatype=PointField.FLOAT32, count=1)
        for axis, name in enumerate('xyz')
    ]
    message.data = array('B', points)
    message.header.frame_id = 'odom'
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    return message


def depth_image(stamp_ns: int, num_bytes: int) -> Image:
    """Return an image of a wall."""
    rows = num_bytes // (2 * COLUMNS)
    message = Image(height=rows, width=COLUMNS, encoding='16UC1', step=2 * COLUMNS)
    message.data = array('B', (2000).to_bytes(2, 'little') * (rows * COLUMNS))
    message.header.frame_id = 'odom'
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    return message


def camera_info(image: Image) -> CameraInfo:
    """Return the calibration of the camera of an image."""
    info = CameraInfo(header=image.header, height=image.height, width=image.width)
    info.k = [525.0, 0.0, 319.5, 0.0, 525.0, 239.5, 0.0, 0.0, 1.0]
    return info


def meet(node: Node, publisher: Publisher) -> None:
    """
    Return when the mapper knows the publisher, as its answer to a later client shows.

    Endpoints are announced in the order of their creation. A server does not answer a client that
    it does not know yet, so the request is repeated.
    """
    while not publisher.get_subscription_count():
        time.sleep(0.05)
    client = node.create_client(GetState, '/surfel_mapper/get_state')
    client.wait_for_service()
    answers: list[Future] = []
    while not any(answer.done() for answer in answers):
        answers.append(client.call_async(GetState.Request()))
        rclpy.spin_until_future_complete(node, answers[-1], timeout_sec=1.0)
    node.destroy_client(client)


def main(reliability: str, number: str, first_ns: str, kind: str) -> None:
    """Publish messages of each size."""
    rclpy.init()
    node = Node('plain_lidar')
    qos = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy[reliability.upper()])
    infos = None
    if kind == 'cloud':
        make, publisher = cloud, node.create_publisher(PointCloud2, '/points', qos)
    else:
        infos = node.create_publisher(CameraInfo, '/depth/camera_info', qos)
        make, publisher = depth_image, node.create_publisher(Image, '/depth/image', qos)
    meet(node, publisher)
    stamp_ns = int(first_ns)
    for size in sys.stdin:
        message = make(stamp_ns, int(size))
        next_s = time.monotonic()
        for count in range(int(number)):
            stamp_ns += 10**8
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            if infos is not None:
                infos.publish(camera_info(message))
            publisher.publish(message)
            if count % DEPTH == DEPTH - 1:
                publisher.wait_for_all_acked(LONGEST_WAIT)
            next_s += 0.1
            time.sleep(max(next_s - time.monotonic(), 0.0))
        print(size.strip(), flush=True)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == '__main__':
    main(*sys.argv[1:])
