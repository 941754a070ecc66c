# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scans are moved until they agree: with each other, or with a map."""

from surfel_mapper.alignment.graph import Graph
from surfel_mapper.alignment.lum import LUM, LumResult

__all__ = ['LUM', 'Graph', 'LumResult']
