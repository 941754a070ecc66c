# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Turn point clouds into a map of surfels: small discs with a normal and a planarity.

    >>> from surfel_mapper import SurfelMap
    >>> surfel_map = SurfelMap(voxel_size_m=0.5)
    >>> moments = surfel_map.add([[1.0, 2.0, 0.1]], origin=[0.0, 0.0, 1.9])
    >>> surfels = surfel_map.surfels()
    >>> _ = surfel_map.remove(moments)  # the exact inverse of add

Maps::

    SurfelMap         a voxel map of surfels, with exact addition and removal of scans
    Surfels           surfels as arrays: position, normal, planarity, ...
    Surfel            one set of points: mean, covariance, normal, planarity
    ScanMoments       a scan reduced to the exact moments of its voxels
    SlidingWindow     the scans of a map, and the limits that evict the oldest
    diff              the differences of two maps
    MapMirror         an exact copy of the map of a node, from its topics
    ModelsMirror      an exact copy of its planes, surfaces and Gaussians
    DistanceField     a signed distance field and its mesh

Pipeline::

    Mapper            from scans and poses to the windowed map, as in the node
    Scan              points with their stamp, frame and columns
    replay            map a bag or a folder of scans, and write map, picture and report
    Config            all settings; load_config reads them from a YAML file
    load_config       the configuration in a YAML file

Further::

    Trajectory        poses over time, from and to files
    estimate_normals  normals of a cloud from neighbours, without a map
    show              an interactive view in a notebook

``help(surfel_mapper.SurfelMap)`` and so on describe each. A name is loaded when first asked for:
importing the package, or one module of it, costs no more than that module needs. The compiler
(numba) alone takes longer to load than ``surfel-mapper --help`` should take. ROS and rosbags are
never loaded from here.
"""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from surfel_mapper.config import Config as Config
    from surfel_mapper.config import load_config as load_config
    from surfel_mapper.files.trajectory import Trajectory as Trajectory
    from surfel_mapper.filters.normals import estimate_normals as estimate_normals
    from surfel_mapper.layers.distance_field import DistanceField as DistanceField
    from surfel_mapper.mapping.differences import diff as diff
    from surfel_mapper.mapping.moments import ScanMoments as ScanMoments
    from surfel_mapper.mapping.surfel import Surfel as Surfel
    from surfel_mapper.mapping.surfel_map import SurfelMap as SurfelMap
    from surfel_mapper.mapping.surfels import Surfels as Surfels
    from surfel_mapper.mapping.window import SlidingWindow as SlidingWindow
    from surfel_mapper.messages.map_cloud import MapMirror as MapMirror
    from surfel_mapper.messages.model_packets import ModelsMirror as ModelsMirror
    from surfel_mapper.offline.replay import replay as replay
    from surfel_mapper.pipeline import Mapper as Mapper
    from surfel_mapper.scan import Scan as Scan
    from surfel_mapper.viz.inline import show as show

__version__ = '0.1.0'

_HOMES = {
    'Config': 'config',
    'DistanceField': 'layers.distance_field',
    'MapMirror': 'messages.map_cloud',
    'Mapper': 'pipeline',
    'ModelsMirror': 'messages.model_packets',
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
"""
The public names, and the module that each comes from. There is no ``__all__``, with which
``help(surfel_mapper)`` would print the methods of all classes.
"""


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
    return sorted({*_HOMES, *(name for name in globals() if name.startswith('__'))})
