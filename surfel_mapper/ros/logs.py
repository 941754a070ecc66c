# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Log lines of the library, which knows no ROS, to the log of a node."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import logging

from rclpy.impl.rcutils_logger import RcutilsLogger


class NodeHandler(logging.Handler):
    """Hands log records to a node's logger."""

    def __init__(self, logger: RcutilsLogger) -> None:
        """Hold the logger."""
        super().__init__()
        self._logger = logger

    def emit(self, record: logging.LogRecord) -> None:
        """Log one record; rclpy wants a line of code of its own for every severity."""
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
    """Send what the package logs to a node's logger, and nowhere else, in a with-block."""
    package = logging.getLogger('surfel_mapper')
    handler, propagate = NodeHandler(logger), package.propagate
    package.addHandler(handler)
    package.propagate = False
    try:
        yield
    finally:
        package.removeHandler(handler)
        package.propagate = propagate
