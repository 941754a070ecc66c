# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Message for users who run a verb that needs ROS 2 without having it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import sys

from surfel_mapper.errors import DependencyError

MIDDLEWARES = 'share/ament_index/resource_index/rmw_typesupport'
"""Directory below a prefix of ROS with a file for each middleware that is installed."""

INSTALL = (
    'On Ubuntu 24.04 with ROS 2 Jazzy from apt: `source /opt/ros/jazzy/setup.bash`, and '
    '`sudo apt install` the package missing. Without such a ROS: '
    "`pip install 'surfel_mapper[ros]'` (Linux on x86_64, Python 3.10 to 3.13)"
)


@contextmanager
def loading_ros() -> Iterator[None]:
    """Turn a failed import in a with-block into an error that says what to install."""
    check_middleware(os.environ.get('RMW_IMPLEMENTATION', ''))
    try:
        yield
    except DependencyError:
        raise
    except ImportError as error:
        raise DependencyError(f'ROS 2 cannot be loaded ({error}). {INSTALL}') from error


def check_middleware(name: str) -> None:
    """
    Raise DependencyError if a middleware is not installed.

    ROS would end the process with a line of its own sources, and without a remedy.
    """
    prefixes = [*filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(':')), sys.prefix]
    folders = [Path(prefix, MIDDLEWARES) for prefix in prefixes]
    files = {path.name for folder in folders for path in folder.glob('rmw_*')}
    installed = files - {'rmw_implementation'}
    if name and installed and name not in installed:
        raise DependencyError(
            f'RMW_IMPLEMENTATION is {name}, which is not installed; installed: '
            f'{", ".join(sorted(installed))}. Unset it, or `sudo apt install '
            f'ros-jazzy-{name.replace("_", "-")}`'
        )
