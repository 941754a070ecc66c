# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes, B-spline surfaces and Gaussians that represent a cloud.

``fit`` computes them from the points of one cloud, ``read`` reads a file; see docs/models.md.
"""

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models.bspline import HeightField
from surfel_mapper.models.evaluation import Evaluation
from surfel_mapper.models.fitting import fit
from surfel_mapper.models.grid import Grid
from surfel_mapper.models.multi_model import evaluate, Gaussians, MultiModel, Plane, read, Surface

__all__ = [
    'Evaluation',
    'Gaussians',
    'Grid',
    'HeightField',
    'ModelsConfig',
    'MultiModel',
    'Plane',
    'Surface',
    'evaluate',
    'fit',
    'read',
]
