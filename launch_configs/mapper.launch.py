# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Start the node: ``ros2 launch surfel_mapper mapper.launch.py points:=/lidar/points rviz:=true``.

Settings come from one file: a preset of this package, or your own with ``config``. An argument
overrides the file only if it is given. With ``namespace`` the views show the topics of that node.
"""

from pathlib import Path
import tempfile

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

HERE = Path(__file__).resolve().parent

PRESETS = ('default', 'spinning_lidar', 'solid_state_lidar', 'indoor_depth_camera')

BOOLEAN = ['true', 'false']

SOURCES = ('auto', 'tf', 'odometry', 'pose', 'identity', 'registration')

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
        'pose_source',
        default_value='',
        choices=['', *SOURCES],
        description='Source of poses; empty: pose.source of the file.',
    ),
    DeclareLaunchArgument(
        'input_kind',
        default_value='',
        choices=['', 'cloud', 'depth'],
        description='Clouds or depth images; empty: input.kind of the file.',
    ),
    DeclareLaunchArgument(
        'voxel_size',
        default_value='',
        description='Edge of a voxel, m; empty: map.voxel_size_m of the file.',
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
        'odom', default_value='odom', description='Topic of odometry, if pose.source takes it.'
    ),
    DeclareLaunchArgument(
        'pose', default_value='pose', description='Topic of poses, if pose.source takes it.'
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
        'respawn',
        default_value='true',
        choices=BOOLEAN,
        description='Start the node again 2 s after its process ended, at most five times.',
    ),
    DeclareLaunchArgument(
        'use_sim_time',
        default_value='',
        choices=['', *BOOLEAN],
        description='Take the time from /clock, as for a bag played with --clock; empty: as set '
        'by an including launch file (SetParameter) or the file.',
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


SETTINGS = {
    'pose_source': ('pose.source', str),
    'input_kind': ('input.kind', str),
    'voxel_size': ('map.voxel_size_m', float),
    'fixed_frame': ('frames.fixed', str),
}
"""Settings that a launch argument overrides if it is not empty, and their types."""


def settings_file(values: dict[str, str]) -> str:
    """Return the path of the settings; a file that does not exist ends the launch."""
    path = Path(values['config'] or HERE / f'{values["preset"]}.yaml').expanduser()
    if not path.is_file():
        raise FileNotFoundError(f'config:={path}: no such file of settings')
    return str(path)


def overrides(values: dict[str, str]) -> list[dict[str, object]]:
    """Return the parameters that the launch arguments set; none if they set no parameter."""
    found: dict[str, object] = simulated_time(values)
    if values['autostart'] == 'false':
        found['autostart'] = False
    for argument, (name, kind) in SETTINGS.items():
        try:
            if values[argument]:
                found[name] = kind(values[argument])
        except ValueError:
            raise ValueError(f'{argument}:={values[argument]}: expected a number') from None
    return [found] if found else []


def simulated_time(values: dict[str, str]) -> dict[str, object]:
    """Return the parameter use_sim_time if the argument is given."""
    value = values['use_sim_time']
    return {'use_sim_time': value == 'true'} if value else {}


def view(values: dict[str, str]) -> str:
    """Return the path of the RViz view; in a namespace, of a copy with its topics."""
    path, namespace = HERE / 'mapper.rviz', values['namespace'].strip('/')
    if not namespace:
        return str(path)
    text = path.read_text(encoding='utf-8')
    for name in ('surfel_mapper/', 'points', 'initialpose'):
        text = text.replace(f'Value: /{name}', f'Value: /{namespace}/{name}')
    with tempfile.NamedTemporaryFile('w', suffix='.rviz', delete=False) as file:
        file.write(text)
    return file.name


def logger(values: dict[str, str]) -> str:
    """Return the name of the node's logger, which has its namespace: robot1.surfel_mapper."""
    return f'{values["namespace"].strip("/")}/surfel_mapper'.lstrip('/').replace('/', '.')


def nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes, once the values of the arguments are known."""
    values = {
        argument.name: LaunchConfiguration(argument.name).perform(context)
        for argument in ARGUMENTS
    }
    found = [
        Node(
            package='surfel_mapper',
            executable='node',
            name='surfel_mapper',
            namespace=values['namespace'],
            output='screen',
            parameters=[settings_file(values), *overrides(values)],
            remappings=[(topic, values[argument]) for argument, topic in TOPICS.items()],
            ros_arguments=['--log-level', f'{logger(values)}:={values["log_level"]}'],
            respawn=values['respawn'] == 'true',
            respawn_delay=2.0,
            respawn_max_retries=5,  # a setting that is refused ends the node each time
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
                arguments=['-d', view(values), *fixed],
                parameters=[simulated_time(values)] if values['use_sim_time'] else [],
            )
        )
    return found


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the nodes for ``ros2 launch``."""
    return LaunchDescription([*ARGUMENTS, OpaqueFunction(function=nodes)])
