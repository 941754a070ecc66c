# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
rclpy from its start to its end.

Signals are ours, not rclpy's: rclpy would end its context at once, after which nothing can be
published, or logged where others see it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import os

import rclpy
from rclpy.signals import SignalHandlerOptions

from surfel_mapper.errors import ConfigError


@contextmanager
def context(ros_args: Sequence[str]) -> Iterator[None]:
    """
    Initialise rclpy for the time of a with-block.

    Parameters
    ----------
    ros_args : sequence of str
        What follows --ros-args on the command line, that included.

    Raises
    ------
    ConfigError
        If rclpy refuses an argument, the file of parameters, or to go without security.

    """
    try:
        rclpy.init(args=list(ros_args), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise ConfigError(f'arguments after --ros-args: {reason(error)}') from error
    try:
        yield
    finally:
        rclpy.try_shutdown()


def reason(error: RuntimeError) -> str:
    """Return why ROS refuses to start; what it says of two things is not enough to go by."""
    said = str(error).partition(', at /')[0]
    if 'before ros__parameters' in said:  # such a file is one for --config of replay
        return f'{said}; put the settings below /**: and ros__parameters:, each indented deeper'
    if os.environ.get('ROS_SECURITY_ENABLE') != 'true':
        return said
    keystore = os.environ.get('ROS_SECURITY_KEYSTORE')
    return (
        f'{said}. ROS_SECURITY_ENABLE is true: ROS_SECURITY_KEYSTORE ({keystore}) has to hold the '
        'enclave of the node, and the middleware to be one that is built with security'
    )
