# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the node publishes of the alignment: the corrected path, and where the odometry is in the map.

The path is that of the scans of the window, after every alignment. The transform from the map to
the frame of the odometry goes out with every scan, stamped as it is, so that it can be looked up
together with the odometry; only where ``align.map_frame`` gives the map a frame of its own, since
a frame has one parent and that of odom may be another's to publish.
"""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import Pose, PoseStamped, TransformStamped
from nav_msgs.msg import Path
import numpy as np
import numpy.typing as npt
from rclpy.node import Node
from std_msgs.msg import Header

from surfel_mapper.errors import DependencyError
from surfel_mapper.geometry import q_xyzw, Transform
from surfel_mapper.pipeline import Alignment, Mapper, Update
from surfel_mapper.ros.inputs import transform_message
from surfel_mapper.ros.messages import time_message
from surfel_mapper.ros.publishing import LATCHED


class AlignmentOutputs:
    """
    Publishers of path and transform; all is called in the mapping thread.

    Parameters
    ----------
    node : Node
        Whose publishers they are.
    mapper : Mapper
        What they publish.

    """

    def __init__(self, node: Node, mapper: Mapper) -> None:
        """Make the publishers; say so where there can be no transform."""
        self._mapper = mapper
        self._path = node.create_publisher(Path, '~/path', LATCHED)
        self._transforms: Any = None
        map_frame = mapper.config.align.map_frame
        if not map_frame:
            return
        try:
            self._message = transform_message()
        except DependencyError as error:
            node.get_logger().warning(
                f'align.map_frame: the transform from {map_frame} to '
                f'{mapper.config.frames.fixed} is not published: {error}'
            )
            return
        self._transforms = node.create_publisher(self._message, '/tf', 100)

    def publish(self, update: Update) -> None:
        """Publish what there is after a scan."""
        if update.alignment is not None:
            self.publish_path(update.alignment)
        if self._transforms is not None:
            self._transforms.publish(self._message(transforms=[self._transform(update.stamp_ns)]))

    def _transform(self, stamp_ns: int) -> TransformStamped:
        """Return where the frame of the odometry is in the map."""
        mapper = self._mapper
        header = Header(stamp=time_message(stamp_ns), frame_id=mapper.map_frame)
        message = TransformStamped(header=header, child_frame_id=mapper.config.frames.fixed)
        fill(message.transform.translation, mapper.T_map_fixed[:3, 3])
        fill(message.transform.rotation, q_xyzw(mapper.T_map_fixed))
        return message

    def publish_path(self, aligned: Alignment) -> None:
        """Publish where the scans are after an alignment."""
        stamps = aligned.stamps_ns.tolist()
        header = Header(stamp=time_message(stamps[-1]), frame_id=self._mapper.map_frame)
        poses = [
            PoseStamped(
                header=Header(stamp=time_message(stamp_ns), frame_id=header.frame_id),
                pose=pose_message(T_map_sensor),
            )
            for stamp_ns, T_map_sensor in zip(stamps, aligned.T_map_sensor, strict=True)
        ]
        self._path.publish(Path(header=header, poses=poses))


def pose_message(T_a_b: Transform) -> Pose:
    """Return a transform as the pose of b in a."""
    pose = Pose()
    fill(pose.position, T_a_b[:3, 3])
    fill(pose.orientation, q_xyzw(T_a_b))
    return pose


def fill(message: Any, values: npt.NDArray[np.float64]) -> None:
    """Put values into the fields x y z, or x y z w, of a message."""
    for name, value in zip('xyzw', values.tolist(), strict=False):
        setattr(message, name, value)
