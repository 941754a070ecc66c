# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The tree of coordinate frames over time."""

from surfel_mapper.poses.buffer import MAX_EDGES, MAX_TRANSFORMS, TransformBuffer

__all__ = ['MAX_EDGES', 'MAX_TRANSFORMS', 'TransformBuffer']
