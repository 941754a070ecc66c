# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The quality of service of recorded topics, as far as it matters: whether messages are latched.

Bags state it as YAML, with numbers or names by their version.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rosbags.interfaces import Qos

TRANSIENT_LOCAL = re.compile(r'durability:\s*(1|transient_local)\b', re.IGNORECASE)


def profiles_in(text: str) -> list[Qos]:
    """Return a profile that is latched, if one in the text of a bag is; else none."""
    return [latched_profile()] if TRANSIENT_LOCAL.search(text) else []


def latched_profile() -> Qos:
    """Return the quality of service of a publisher that keeps its last message for latecomers."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    never = QosTime(sec=9223372036, nsec=854775807)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL,
        deadline=never,
        lifespan=never,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=never,
        avoid_ros_namespace_conventions=False,
    )
