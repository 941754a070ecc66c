# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters that clean and thin scans before they are mapped, and chains of them.

    >>> from surfel_mapper.filters import Chain, VoxelGrid
    >>> VoxelGrid(size_x_m=0.1, size_y_m=0.1, size_z_m=0.1).apply(points).points
    >>> Chain.from_yaml('[range_limit: {min_m: 0.5}, voxel_grid]').apply(points)

Each name is loaded when first asked for: a node without filters starts without their kernels.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from surfel_mapper.filters.base import (
        as_scan,
        Filter,
        finite,
        FiniteFilter,
        generator,
        parameter,
        select,
        with_columns,
        with_points,
    )
    from surfel_mapper.filters.boxes import Ellipsoids, SamplingSurfaceNormal
    from surfel_mapper.filters.chain import Chain, Step
    from surfel_mapper.filters.descriptors import (
        AddDescriptor,
        CutAtDescriptorThreshold,
        IncidenceAngle,
        LabelMask,
        ObservationDirection,
        OrientNormals,
        Sphericality,
        TimeSlice,
    )
    from surfel_mapper.filters.gestalt import Gestalt
    from surfel_mapper.filters.grids import OctreeGrid, VoxelGrid
    from surfel_mapper.filters.ground import Ground
    from surfel_mapper.filters.limits import (
        AngleLimit,
        BodyBox,
        BoundingBox,
        DistanceLimit,
        FieldOfView,
        Identity,
        MaxDist,
        MinDist,
        RangeLimit,
        RemoveNaN,
    )
    from surfel_mapper.filters.neighbours import RadiusOutliers, StatisticalOutliers
    from surfel_mapper.filters.registry import all_filters, find, register
    from surfel_mapper.filters.sampling import (
        CovarianceSampling,
        FarthestPointSampling,
        FixStepSampling,
        MaxDensity,
        MaxPointCount,
        MaxQuantileOnAxis,
        NormalSpace,
        RandomSampling,
    )
    from surfel_mapper.filters.sensor_models import RemoveSensorBias, Shadow, SimpleSensorNoise
    from surfel_mapper.filters.shapes import SurfaceNormal
    from surfel_mapper.filters.tensor_voting import Saliency, SpectralDecomposition

__all__ = [
    'AddDescriptor',
    'AngleLimit',
    'BodyBox',
    'BoundingBox',
    'Chain',
    'CovarianceSampling',
    'CutAtDescriptorThreshold',
    'DistanceLimit',
    'Ellipsoids',
    'FarthestPointSampling',
    'FieldOfView',
    'Filter',
    'FiniteFilter',
    'FixStepSampling',
    'Gestalt',
    'Ground',
    'Identity',
    'IncidenceAngle',
    'LabelMask',
    'MaxDensity',
    'MaxDist',
    'MaxPointCount',
    'MaxQuantileOnAxis',
    'MinDist',
    'NormalSpace',
    'ObservationDirection',
    'OctreeGrid',
    'OrientNormals',
    'RadiusOutliers',
    'RandomSampling',
    'RangeLimit',
    'RemoveNaN',
    'RemoveSensorBias',
    'Saliency',
    'SamplingSurfaceNormal',
    'Shadow',
    'SimpleSensorNoise',
    'SpectralDecomposition',
    'Sphericality',
    'StatisticalOutliers',
    'Step',
    'SurfaceNormal',
    'TimeSlice',
    'VoxelGrid',
    'all_filters',
    'as_scan',
    'find',
    'finite',
    'generator',
    'parameter',
    'register',
    'select',
    'with_columns',
    'with_points',
]

_HOMES = {
    'AddDescriptor': 'descriptors',
    'AngleLimit': 'limits',
    'BodyBox': 'limits',
    'BoundingBox': 'limits',
    'Chain': 'chain',
    'CovarianceSampling': 'sampling',
    'CutAtDescriptorThreshold': 'descriptors',
    'DistanceLimit': 'limits',
    'Ellipsoids': 'boxes',
    'FarthestPointSampling': 'sampling',
    'FieldOfView': 'limits',
    'Filter': 'base',
    'FiniteFilter': 'base',
    'FixStepSampling': 'sampling',
    'Gestalt': 'gestalt',
    'Ground': 'ground',
    'Identity': 'limits',
    'IncidenceAngle': 'descriptors',
    'LabelMask': 'descriptors',
    'MaxDensity': 'sampling',
    'MaxDist': 'limits',
    'MaxPointCount': 'sampling',
    'MaxQuantileOnAxis': 'sampling',
    'MinDist': 'limits',
    'NormalSpace': 'sampling',
    'ObservationDirection': 'descriptors',
    'OctreeGrid': 'grids',
    'OrientNormals': 'descriptors',
    'RadiusOutliers': 'neighbours',
    'RandomSampling': 'sampling',
    'RangeLimit': 'limits',
    'RemoveNaN': 'limits',
    'RemoveSensorBias': 'sensor_models',
    'Saliency': 'tensor_voting',
    'SamplingSurfaceNormal': 'boxes',
    'Shadow': 'sensor_models',
    'SimpleSensorNoise': 'sensor_models',
    'SpectralDecomposition': 'tensor_voting',
    'Sphericality': 'descriptors',
    'StatisticalOutliers': 'neighbours',
    'Step': 'chain',
    'SurfaceNormal': 'shapes',
    'TimeSlice': 'descriptors',
    'VoxelGrid': 'grids',
    'all_filters': 'registry',
    'as_scan': 'base',
    'find': 'registry',
    'finite': 'base',
    'generator': 'base',
    'parameter': 'base',
    'register': 'registry',
    'select': 'base',
    'with_columns': 'base',
    'with_points': 'base',
}
"""The module that each public name comes from."""


def __getattr__(name: str) -> Any:
    """Load a public name from its module when it is first asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return sorted({*globals(), *__all__})
