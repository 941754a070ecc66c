# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The surroundings of a node in its process: the rclpy context, its log, and Fast DDS' settings.

Signals are handled by us, not by rclpy: rclpy would shut its context down at once, after which
nothing can be published or sent to /rosout.

By default Fast DDS has half a megabyte of shared memory, and sends larger messages in fragments
that overwrite each other if they are not taken at once: of best-effort clouds of 4 MiB at most 3 %
arrived, with the profile beside this file all. The profile matters to the process that publishes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import logging
import os
from pathlib import Path

import rclpy
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.signals import SignalHandlerOptions

from surfel_mapper.errors import ConfigError, LineFormatter

PROFILE = Path(__file__).with_name('fastdds_shm.xml')

UDP_PROFILE = Path(__file__).with_name('fastdds_udp.xml')

FASTDDS_VARIABLES = (
    'FASTDDS_BUILTIN_TRANSPORTS',
    'FASTDDS_DEFAULT_PROFILES_FILE',
    'FASTRTPS_DEFAULT_PROFILES_FILE',
)
"""Environment variables that configure Fast DDS; if the user has set one, we set none."""

NEEDED_BYTES = 80 << 20
"""Free space in /dev/shm that the profile needs: its segment of 64 MiB and some room."""

log = logging.getLogger(__name__)


@contextmanager
def context(ros_args: Sequence[str]) -> Iterator[None]:
    """
    Initialise rclpy for the duration of a with-block.

    Parameters
    ----------
    ros_args : sequence of str
        The command line from --ros-args on, that included.

    Raises
    ------
    ConfigError
        If rclpy refuses an argument, the parameter file, or to start without security.

    """
    try:
        rclpy.init(args=list(ros_args), signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, UnicodeError) as error:  # the latter: a file's name is no text
        raise ConfigError(f'arguments after --ros-args: {explain(error)}') from error
    try:
        yield
    finally:
        rclpy.try_shutdown()


def explain(error: RuntimeError | UnicodeError) -> str:
    """Return why ROS refuses to start; adds a remedy to messages that lack one."""
    reason = str(error).partition(', at /')[0]
    if 'log directory' in reason:
        return f'{reason}. Set ROS_LOG_DIR to a directory that can be written'
    if 'before ros__parameters' in reason:  # such a file is one for --config of replay
        return f'{reason}; put the settings below /**: and ros__parameters:, each indented deeper'
    if os.environ.get('ROS_SECURITY_ENABLE') != 'true':
        return reason
    keystore = os.environ.get('ROS_SECURITY_KEYSTORE')
    return (
        f'{reason}. ROS_SECURITY_ENABLE is true: ROS_SECURITY_KEYSTORE ({keystore}) has to hold '
        'the enclave of the node, and the middleware has to be built with security'
    )


class NodeHandler(logging.Handler):
    """Forwards log records of the library, which knows no ROS, to a node's logger."""

    def __init__(self, logger: RcutilsLogger) -> None:
        super().__init__()
        self.setFormatter(LineFormatter())
        self._logger = logger

    def emit(self, record: logging.LogRecord) -> None:
        """Log one record; rclpy requires a separate line of code for every severity."""
        text = self.format(record)
        if record.levelno >= logging.ERROR:
            self._logger.error(text)
        elif record.levelno >= logging.WARNING:
            self._logger.warning(text)
        elif record.levelno >= logging.INFO:
            self._logger.info(text)
        else:
            self._logger.debug(text)


@contextmanager
def logging_to(logger: RcutilsLogger) -> Iterator[None]:
    """Send the log of this package to a node's logger, and nowhere else, in a with-block."""
    package = logging.getLogger('surfel_mapper')
    handler, propagate, level = NodeHandler(logger), package.propagate, package.level
    package.addHandler(handler)
    package.propagate = False
    package.setLevel(logging.INFO)
    try:
        yield
    finally:
        package.removeHandler(handler)
        package.propagate = propagate
        package.setLevel(level)


def enlarge_shared_memory() -> None:
    """
    Give Fast DDS the profile, before rclpy is initialised.

    Does nothing if the user has configured Fast DDS, or if /dev/shm has no room for it.
    """
    if any(os.environ.get(name) for name in FASTDDS_VARIABLES):
        return
    try:
        system = os.statvfs('/dev/shm')
    except OSError:
        return  # not Linux: no shared memory of this kind
    free = system.f_bavail * system.f_frsize
    if free < NEEDED_BYTES:
        log.warning(
            '/dev/shm has %d MB free, but large clouds in shared memory need %d MB; some may be '
            'lost. In a container enlarge it (docker run --shm-size 256m)',
            free >> 20,
            NEEDED_BYTES >> 20,
        )
        return
    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
    os.environ['FASTDDS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
