# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The pipeline from scans and poses to a windowed map of surfels: Mapper, and its parts."""

from surfel_mapper.pipeline.drops import ScanOutcome
from surfel_mapper.pipeline.mapper import Mapper
from surfel_mapper.pipeline.update import Update
from surfel_mapper.pipeline.window_aligner import Alignment

__all__ = ['Alignment', 'Mapper', 'ScanOutcome', 'Update']
