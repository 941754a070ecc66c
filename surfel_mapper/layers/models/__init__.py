# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Planes, B-spline surfaces and Gaussians that follow the map."""

from surfel_mapper.layers.models.layer import ModelsLayer

__all__ = ['ModelsLayer']
