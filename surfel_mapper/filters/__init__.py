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
    from surfel_mapper.filters.base import *  # noqa: F403
    from surfel_mapper.filters.boxes import *  # noqa: F403
    from surfel_mapper.filters.chain import *  # noqa: F403
    from surfel_mapper.filters.descriptors import *  # noqa: F403
    from surfel_mapper.filters.gestalt import *  # noqa: F403
    from surfel_mapper.filters.grids import *  # noqa: F403
    from surfel_mapper.filters.ground import *  # noqa: F403
    from surfel_mapper.filters.limits import *  # noqa: F403
    from surfel_mapper.filters.neighbours import *  # noqa: F403
    from surfel_mapper.filters.registry import *  # noqa: F403
    from surfel_mapper.filters.sampling import *  # noqa: F403
    from surfel_mapper.filters.sensor_models import *  # noqa: F403
    from surfel_mapper.filters.shapes import *  # noqa: F403
    from surfel_mapper.filters.tensor_voting import *  # noqa: F403

_HOMES = {
    name: module
    for module, names in {
        'base': 'as_scan Filter finite FiniteFilter generator parameter select with_columns '
        'with_points',
        'boxes': 'Ellipsoids SamplingSurfaceNormal',
        'chain': 'Chain Step',
        'descriptors': 'AddDescriptor CutAtDescriptorThreshold IncidenceAngle LabelMask '
        'ObservationDirection OrientNormals Sphericality TimeSlice',
        'gestalt': 'Gestalt',
        'grids': 'OctreeGrid VoxelGrid',
        'ground': 'Ground',
        'limits': 'AngleLimit BodyBox BoundingBox DistanceLimit FieldOfView Identity MaxDist '
        'MinDist RangeLimit RemoveNaN',
        'neighbours': 'RadiusOutliers StatisticalOutliers',
        'registry': 'all_filters find register',
        'sampling': 'CovarianceSampling FarthestPointSampling FixStepSampling MaxDensity '
        'MaxPointCount MaxQuantileOnAxis NormalSpace RandomSampling',
        'sensor_models': 'RemoveSensorBias Shadow SimpleSensorNoise',
        'shapes': 'SurfaceNormal',
        'tensor_voting': 'Saliency SpectralDecomposition',
    }.items()
    for name in names.split()
}
"""The module that each public name comes from."""

__all__ = sorted(_HOMES)


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
