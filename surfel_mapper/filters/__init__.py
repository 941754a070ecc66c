# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters that clean and thin scans before they are mapped, and chains of them.

    >>> from surfel_mapper.filters import Chain, VoxelGrid
    >>> VoxelGrid(size_x_m=0.1, size_y_m=0.1, size_z_m=0.1).apply(points).points
    >>> Chain.from_yaml('[range_limit: {min_m: 0.5}, voxel_grid]').apply(points)

Filters are loaded when a name is first asked for: a node without any starts without their kernels.
"""

from __future__ import annotations

from functools import cache
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

_HELPERS = {
    'base': 'as_scan Filter finite FiniteFilter generator parameter select with_columns '
    'with_points',
    'chain': 'Chain Step',
    'registry': 'all_filters find register',
}
"""Public names besides the filters, by module."""


@cache
def _public() -> dict[str, Any]:
    """Return the public names and their values: the registered filters, and the helpers."""
    names = {cls.__name__: cls for cls in import_module(f'{__name__}.registry').built_in()}
    for module, helpers in _HELPERS.items():
        home = import_module(f'{__name__}.{module}')
        names.update((name, getattr(home, name)) for name in helpers.split())
    return names


def __getattr__(name: str) -> Any:
    """Load the filters when a public name is first asked for (PEP 562)."""
    if name == '__all__':
        return sorted(_public())
    if name.startswith('_') or name not in _public():
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return globals().setdefault(name, _public()[name])


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted({*globals(), *_public()})
