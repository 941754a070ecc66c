# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The truncated signed distance field: fused from scans, published as mesh and slice."""

from surfel_mapper.layers.distance_field.field import DistanceField
from surfel_mapper.layers.distance_field.layer import TsdfLayer
from surfel_mapper.layers.distance_field.obstacles import clearance_slice, slice_at

__all__ = [
    'DistanceField',
    'TsdfLayer',
    'clearance_slice',
    'slice_at',
]
