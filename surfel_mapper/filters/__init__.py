# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters that clean and thin scans before they are mapped, and chains of them.

    >>> from surfel_mapper.filters import Chain, VoxelGrid
    >>> VoxelGrid(size_x_m=0.1, size_y_m=0.1, size_z_m=0.1).apply(points).points
    >>> Chain.from_yaml('[range_limit: {min_m: 0.5}, voxel_grid]').apply(points)
"""

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
