# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The tree of coordinate frames over time, and the choice of the source of poses."""

from surfel_mapper.poses.buffer import MAX_EDGES as MAX_EDGES
from surfel_mapper.poses.buffer import MAX_TRANSFORMS as MAX_TRANSFORMS
from surfel_mapper.poses.buffer import TransformBuffer as TransformBuffer
from surfel_mapper.poses.clock_offset import ClockOffset as ClockOffset
from surfel_mapper.poses.clock_offset import offset_s as offset_s
from surfel_mapper.poses.mount_changes import MountChanges as MountChanges
from surfel_mapper.poses.source_choice import above as above
from surfel_mapper.poses.source_choice import AUTO as AUTO
from surfel_mapper.poses.source_choice import choose_source as choose_source
from surfel_mapper.poses.source_choice import has_chain as has_chain
from surfel_mapper.poses.source_choice import PoseCandidate as PoseCandidate
from surfel_mapper.poses.source_choice import SourceChoice as SourceChoice
from surfel_mapper.poses.source_choice import without_chain as without_chain
