# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Start the node: ``ros2 launch surfel_mapper mapper.launch.py points:=/lidar/points``.

``fixed_frame`` overrides the file of settings only where it is given, so that a file alone says
what runs.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

DEFAULT_CONFIG = PathJoinSubstitution(
    [FindPackageShare('surfel_mapper'), 'launch_configs', 'default.yaml']
)

ARGUMENTS = [
    DeclareLaunchArgument(
        'config', default_value=DEFAULT_CONFIG, description='YAML file of the settings.'
    ),
    DeclareLaunchArgument(
        'points', default_value='points', description='Topic of the clouds, PointCloud2.'
    ),
    DeclareLaunchArgument(
        'odom', default_value='odom', description='Topic of odometry, for pose.source odometry.'
    ),
    DeclareLaunchArgument(
        'pose', default_value='pose', description='Topic of poses, for pose.source pose.'
    ),
    DeclareLaunchArgument(
        'fixed_frame',
        default_value='',
        description='Frame of the map and of all output; empty: frames.fixed of the file.',
    ),
    DeclareLaunchArgument(
        'use_sim_time',
        default_value='false',
        choices=['true', 'false'],
        description='Take the time from /clock, as for a bag played with --clock.',
    ),
]


def mapper_node(context: LaunchContext) -> list[Node]:
    """Return the node, once the values of the arguments are known."""
    values = {
        argument.name: LaunchConfiguration(argument.name).perform(context)
        for argument in ARGUMENTS
    }
    overrides: dict[str, object] = {'use_sim_time': values['use_sim_time'] == 'true'}
    if values['fixed_frame']:
        overrides['frames.fixed'] = values['fixed_frame']
    return [
        Node(
            package='surfel_mapper',
            executable='node',
            name='surfel_mapper',
            output='screen',
            parameters=[values['config'], overrides],
            remappings=[(topic, values[topic]) for topic in ('points', 'odom', 'pose')],
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Return what ``ros2 launch`` runs."""
    return LaunchDescription([*ARGUMENTS, OpaqueFunction(function=mapper_node)])
