# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Publish clouds as an ordinary driver does: rclpy and its defaults, nothing of this package.

``python plain_publisher.py reliable|best_effort NUMBER FIRST_STAMP_NS`` publishes, once the topic
has a subscriber, NUMBER messages at 10 Hz for each size in bytes read from stdin, and confirms
each size on stdout. A reliable publisher waits until the messages that it keeps have arrived, as
on a loaded machine its queue overflows.
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
from sensor_msgs.msg import PointCloud2, PointField

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


def main(reliability: str, number: str, first_ns: str) -> None:
    """Publish messages of each size."""
    rclpy.init()
    node = Node('plain_lidar')
    qos = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy[reliability.upper()])
    publisher = node.create_publisher(PointCloud2, '/points', qos)
    meet(node, publisher)
    stamp_ns = int(first_ns)
    for size in sys.stdin:
        message = cloud(stamp_ns, int(size))
        next_s = time.monotonic()
        for count in range(int(number)):
            stamp_ns += 10**8
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
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
