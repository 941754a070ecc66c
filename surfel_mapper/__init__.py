# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Turn point clouds into a map of surfels: small discs with a normal and a planarity.

The public names stand in ``__all__``. Each is loaded when first asked for, so that importing the
package, or one module of it, costs no more than that module needs: the compiler (numba) alone
takes longer to load than ``surfel-mapper --help`` should take. ROS and rosbags are never loaded
from here.
"""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from surfel_mapper.config import Config, load_config
    from surfel_mapper.files.trajectory import Trajectory
    from surfel_mapper.filters.normals import estimate_normals
    from surfel_mapper.layers.distance_field import DistanceField
    from surfel_mapper.mapping.differences import diff
    from surfel_mapper.mapping.moments import ScanMoments
    from surfel_mapper.mapping.surfel import Surfel
    from surfel_mapper.mapping.surfel_map import SurfelMap
    from surfel_mapper.mapping.surfels import Surfels
    from surfel_mapper.mapping.window import SlidingWindow
    from surfel_mapper.messages.map_cloud import MapMirror
    from surfel_mapper.offline.replay import replay
    from surfel_mapper.pipeline import Mapper
    from surfel_mapper.scan import Scan
    from surfel_mapper.viz.inline import show

__version__ = '0.1.0'

__all__ = [
    'Config',
    'DistanceField',
    'MapMirror',
    'Mapper',
    'Scan',
    'ScanMoments',
    'SlidingWindow',
    'Surfel',
    'SurfelMap',
    'Surfels',
    'Trajectory',
    '__version__',
    'diff',
    'estimate_normals',
    'load_config',
    'replay',
    'show',
]

_HOMES = {
    'Config': 'config',
    'DistanceField': 'layers.distance_field',
    'MapMirror': 'messages.map_cloud',
    'Mapper': 'pipeline',
    'Scan': 'scan',
    'ScanMoments': 'mapping.moments',
    'SlidingWindow': 'mapping.window',
    'Surfel': 'mapping.surfel',
    'SurfelMap': 'mapping.surfel_map',
    'Surfels': 'mapping.surfels',
    'Trajectory': 'files.trajectory',
    'diff': 'mapping.differences',
    'estimate_normals': 'filters.normals',
    'load_config': 'config',
    'replay': 'offline.replay',
    'show': 'viz.inline',
}
"""The module that each public name comes from."""


def __getattr__(name: str) -> Any:
    """Load a public name from its module when it is first asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)
    globals()[name] = value
    return value


_FORMATS = {'files': 'files.maps', 'messages': 'messages.map_cloud'}
"""The modules that save maps and read messages; see map_formats."""


for _kind, _module in _FORMATS.items():
    import_module(f'{__name__}.map_formats').register(
        _kind, partial(import_module, f'{__name__}.{_module}')
    )


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return sorted({*globals(), *__all__})
