# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Start the node: ``ros2 launch surfel_mapper mapper.launch.py points:=/lidar/points rviz:=true``.

Settings come from one file: a preset of this package, or your own with ``config``. An argument
overrides the file only if it is given.
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

HERE = Path(__file__).resolve().parent

PRESETS = ('default', 'spinning_lidar', 'solid_state_lidar', 'indoor_depth_camera')

BOOLEAN = ['true', 'false']

ARGUMENTS = [
    DeclareLaunchArgument(
        'preset',
        default_value='default',
        choices=list(PRESETS),
        description='Settings to start from, a YAML file of that name beside this one.',
    ),
    DeclareLaunchArgument(
        'config', default_value='', description='YAML file of the settings, instead of a preset.'
    ),
    DeclareLaunchArgument(
        'points', default_value='points', description='Topic of the clouds, PointCloud2.'
    ),
    DeclareLaunchArgument(
        'depth',
        default_value='depth/image',
        description='Topic of depth images, for input.kind depth; camera_info is beside it.',
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
        'namespace', default_value='', description='Namespace of the node and its topics.'
    ),
    DeclareLaunchArgument(
        'autostart',
        default_value='true',
        choices=BOOLEAN,
        description='Configure and activate at once; false: wait for these transitions.',
    ),
    DeclareLaunchArgument(
        'use_sim_time',
        default_value='false',
        choices=BOOLEAN,
        description='Take the time from /clock, as for a bag played with --clock.',
    ),
    DeclareLaunchArgument(
        'rviz', default_value='false', choices=BOOLEAN, description='Start RViz with its view.'
    ),
    DeclareLaunchArgument(
        'log_level',
        default_value='info',
        choices=['debug', 'info', 'warn', 'error'],
        description='Least severity that the node logs.',
    ),
]

TOPICS = {'points': 'points', 'depth': 'depth/image', 'odom': 'odom', 'pose': 'pose'}
"""Relative names of the topics that the node reads, by launch argument."""


def nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes, once the values of the arguments are known."""
    values = {
        argument.name: LaunchConfiguration(argument.name).perform(context)
        for argument in ARGUMENTS
    }
    use_sim_time = {'use_sim_time': values['use_sim_time'] == 'true'}
    overrides: dict[str, object] = {**use_sim_time}
    if values['fixed_frame']:
        overrides['frames.fixed'] = values['fixed_frame']
    if values['autostart'] == 'false':
        overrides['autostart'] = False
    found = [
        Node(
            package='surfel_mapper',
            executable='node',
            name='surfel_mapper',
            namespace=values['namespace'],
            output='screen',
            parameters=[values['config'] or str(HERE / f'{values["preset"]}.yaml'), overrides],
            remappings=[(topic, values[argument]) for argument, topic in TOPICS.items()],
            ros_arguments=['--log-level', f'surfel_mapper:={values["log_level"]}'],
        )
    ]
    if values['rviz'] == 'true':
        fixed = ['-f', values['fixed_frame']] if values['fixed_frame'] else []
        found.append(
            Node(
                package='rviz2',
                executable='rviz2',
                name='surfel_mapper_rviz',
                namespace=values['namespace'],
                output='log',
                arguments=['-d', str(HERE / 'mapper.rviz'), *fixed],
                parameters=[use_sim_time],
            )
        )
    return found


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the nodes for ``ros2 launch``."""
    return LaunchDescription([*ARGUMENTS, OpaqueFunction(function=nodes)])
