# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Filters that clean and thin scans before they are mapped, and chains of them."""

from surfel_mapper.filters.base import (
    Filter,
    generator,
    parameter,
    select,
    with_columns,
    with_points,
)
from surfel_mapper.filters.chain import Chain, Step
from surfel_mapper.filters.registry import register

__all__ = [
    'Chain',
    'Filter',
    'Step',
    'generator',
    'parameter',
    'register',
    'select',
    'with_columns',
    'with_points',
]
