# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Layers: representations beside the surfels that follow the scans, behind one protocol."""

from surfel_mapper.layers.layer import (
    Contains,
    Images,
    InsertedScan,
    Layer,
    Moment,
    Publication,
    Surroundings,
)
from surfel_mapper.layers.registry import enabled, names, register, unregister

__all__ = [
    'Contains',
    'Images',
    'InsertedScan',
    'Layer',
    'Moment',
    'Publication',
    'Surroundings',
    'enabled',
    'names',
    'register',
    'unregister',
]
