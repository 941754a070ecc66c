# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Costs of the ground for navigation."""

from surfel_mapper.layers.costs.layer import CostsLayer
from surfel_mapper.layers.costs.traversability import (
    CostGrid,
    OBSTACLE,
    traversability,
    UNKNOWN,
)

__all__ = ['OBSTACLE', 'UNKNOWN', 'CostGrid', 'CostsLayer', 'traversability']
