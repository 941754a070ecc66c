# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Clearing of voxels that later scans see through."""

from surfel_mapper.layers.dynamic_objects.layer import DynamicObjectsLayer

__all__ = ['DynamicObjectsLayer']
