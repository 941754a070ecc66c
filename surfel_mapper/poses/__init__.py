# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The tree of coordinate frames over time, and the choice of the source of poses."""

from surfel_mapper.poses.buffer import MAX_EDGES, MAX_TRANSFORMS, TransformBuffer
from surfel_mapper.poses.clock_offset import ClockOffset, offset_s
from surfel_mapper.poses.mount_changes import MountChanges
from surfel_mapper.poses.source_choice import (
    AUTO,
    choose_source,
    has_chain,
    PoseCandidate,
    SourceChoice,
    without_chain,
)

__all__ = [
    'AUTO',
    'MAX_EDGES',
    'MAX_TRANSFORMS',
    'ClockOffset',
    'MountChanges',
    'PoseCandidate',
    'SourceChoice',
    'TransformBuffer',
    'choose_source',
    'has_chain',
    'offset_s',
    'without_chain',
]
