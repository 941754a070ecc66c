# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Alignment of scans: to each other by LUM, or to a map by registration."""

from surfel_mapper.alignment.correspondences import (
    Limits,
    loop_candidates,
    match,
    Samples,
    surface_weights,
)
from surfel_mapper.alignment.graph import Graph
from surfel_mapper.alignment.lum import LUM, LumResult
from surfel_mapper.alignment.window import align_scans, WindowAlignment

__all__ = [
    'LUM',
    'Graph',
    'Limits',
    'LumResult',
    'Samples',
    'WindowAlignment',
    'align_scans',
    'loop_candidates',
    'match',
    'surface_weights',
]
