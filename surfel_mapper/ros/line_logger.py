# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The logger of a node, whose messages are one line each.

Frames, file names and the texts of errors come from outside; a line break in one would forge a
line of the log.
"""

from __future__ import annotations

import os
from typing import Any

from rclpy.impl import rcutils_logger
from rclpy.impl.rcutils_logger import RcutilsLogger

from surfel_mapper.errors import one_line

rcutils_logger._internal_callers.append(os.path.realpath(__file__))  # as rclpy documents there


class LineLogger(RcutilsLogger):
    """A logger of rclpy that escapes control characters."""

    def log(self, message: object, severity: Any, **kwargs: Any) -> bool:
        """Log a message as one line; see RcutilsLogger.log."""
        return bool(super().log(one_line(message), severity, **kwargs))
