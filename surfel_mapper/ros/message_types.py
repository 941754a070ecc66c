# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Classes of message types by their names, which come from bags and from the network."""

from __future__ import annotations

from importlib import import_module
import os
from pathlib import Path
import re
import sys
from typing import Any

from surfel_mapper.errors import DependencyError

TYPE_NAME = re.compile(r'([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)')
"""A message type; the name of a package has neither dots nor capitals."""

MESSAGE_PACKAGES = frozenset(
    {
        'builtin_interfaces',
        'diagnostic_msgs',
        'geometry_msgs',
        'nav_msgs',
        'rosgraph_msgs',
        'sensor_msgs',
        'std_msgs',
        'tf2_msgs',
        'visualization_msgs',
    }
)
"""Packages of messages that this package depends on, for a ROS from PyPI without ament index."""


def message_type(name: str) -> Any:
    """
    Return the class of a message type such as nav_msgs/msg/Odometry.

    The name comes from a bag, so it is looked up before anything is imported: the package must
    be one that the ament index lists as having interfaces, or one that this package depends on.
    Importing by the text of a bag ran a Python package that lay in the working directory.

    Raises
    ------
    DependencyError
        If the name is not package/msg/Name, or its package is not an installed one of messages.

    """
    match = TYPE_NAME.fullmatch(name)
    if match is None:
        raise DependencyError(f'its type {name!r} is not package/msg/Name')
    package, message = match.groups()
    if package not in MESSAGE_PACKAGES and package not in packages_with_messages():
        raise DependencyError(
            f'its type {name} is not installed: no package {package} of messages'
        )
    try:
        return getattr(import_module(f'{package}.msg'), message)
    except (ImportError, AttributeError) as error:
        raise DependencyError(f'its type {name} is not installed ({error})') from error


def packages_with_messages() -> frozenset[str]:
    """Return the packages that the ament index lists with ROS interfaces; none without ament."""
    packages = set[str]()
    for prefix in [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]:
        folder = Path(prefix, 'share', 'ament_index', 'resource_index', 'rosidl_interfaces')
        if prefix and folder.is_dir():
            packages.update(path.name for path in folder.iterdir())
    return frozenset(packages)
