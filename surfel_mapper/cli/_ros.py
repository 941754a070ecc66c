# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Message for users who run a verb that needs ROS 2 without having it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from surfel_mapper.errors import DependencyError

INSTALL = (
    'On Ubuntu 24.04 with ROS 2 Jazzy from apt: `source /opt/ros/jazzy/setup.bash`, and '
    '`sudo apt install` the package missing. Without such a ROS: '
    "`pip install 'surfel_mapper[ros]'` (Linux on x86_64, Python 3.10 to 3.13)"
)


@contextmanager
def loading_ros() -> Iterator[None]:
    """Turn a failed import in a with-block into an error that says what to install."""
    try:
        yield
    except DependencyError:
        raise
    except ImportError as error:
        raise DependencyError(f'ROS 2 cannot be loaded ({error}). {INSTALL}') from error
