# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Contents: what files and directories hold that can be shown, in the coordinates of the fixed frame.

Exact maps (npz, Parquet, tiles) can be shown at every level of detail. Surfels in PLY and PCD have
lost their moments, so they are shown as they are; discs without a stated size get that of the gaps
between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files import map_state, parquet, ply
from surfel_mapper.files.arrays import is_cloud
from surfel_mapper.files.latest_map import DRAWABLE, map_in
from surfel_mapper.files.parquet_tiles import read_tiles
from surfel_mapper.files.point_columns import NORMAL_NAMES, normals_in, with_one_colour
from surfel_mapper.files.scan_files import looks_like_points, read_scan
from surfel_mapper.files.scan_files import SUFFIXES as CLOUDS
from surfel_mapper.files.text_points import SUFFIXES as TABLES
from surfel_mapper.files.trajectory import read_trajectory, Trajectory
from surfel_mapper.files.trajectory import SUFFIXES as TRAJECTORIES
from surfel_mapper.files.triangles import read_triangles
from surfel_mapper.files.triangles import SUFFIXES as TRIANGLES
from surfel_mapper.mapping.moments import ScanMoments, unpack_keys
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.discs import DrawnDiscs, RGB, SPREAD

Array = npt.NDArray[np.float64]

EXACT = ('.npz', '.parquet')

BESIDE = ('mesh.ply', 'models.obj', 'models.glb', 'trajectory.tum')
"""Further files of a replay that are shown."""

COORDINATES = {*'xyz', *itertools.chain(*NORMAL_NAMES)}

NEIGHBOURS = 20_000
"""Number of points whose nearest neighbours decide the size of discs without one."""


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """
    A map, surfels or points, a mesh, or poses.

    Attributes
    ----------
    name : str
        Path in the viewer, below ``map``.
    shape : ScanMoments, DrawnDiscs, (N, 3) float64, Mesh or Trajectory
        Moments in the frame of their map, all others in the fixed frame.
    origin_m : (3,) float64, m
        Of a map.
    scans : list of WindowedScan
        Those of the window of a map, for ages.

    """

    name: str
    shape: ScanMoments | DrawnDiscs | Array | Mesh | Trajectory
    origin_m: Array = field(default_factory=lambda: np.zeros(3))
    scans: list[WindowedScan] = field(default_factory=list)

    def positions(self) -> Array:
        """Return positions in the fixed frame, (N, 3) m; of a map up to some 100,000 voxels."""
        shape = self.shape
        if isinstance(shape, ScanMoments):
            index = unpack_keys(shape.key[:: max(len(shape) // 100_000, 1)])
            return np.asarray((index + 0.5) * shape.voxel_size_m + self.origin_m, np.float64)
        if isinstance(shape, Mesh):
            return shape.vertices
        if isinstance(shape, Trajectory):
            return shape.xyz
        return shape.position if isinstance(shape, DrawnDiscs) else shape


def is_shown(path: Path) -> bool:
    """Return whether ``contents`` reads a path; others are bags or folders of scans."""
    if path.is_dir():
        named = any((path / name).is_file() for name in BESIDE)
        return named or map_in(path, DRAWABLE) is not None
    return path.suffix.lower() in (*EXACT, *TRIANGLES, *TRAJECTORIES, *CLOUDS)


def contents(path: Path, name: str = '') -> Iterator[Content]:
    """
    Yield what a file or an output directory holds.

    Parameters
    ----------
    path : Path
        A map (.npz, .parquet, .ply, .pcd, dataset of tiles), a cloud (.ply, .pcd, .bin, .las), a
        mesh (.ply, .obj, .stl, .glb), a trajectory (.tum, .csv, KITTI), or the output of a replay
        or merge with any of them.
    name : str
        Path in the viewer for a file, below ``map``; that of the file without.

    Raises
    ------
    FileFormatError
        If it cannot be read, or holds nothing that can be shown.

    """
    if path.is_dir():
        yield from in_directory(path, name)
        return
    if not path.exists():
        raise FileFormatError(f'{path}: no such file or directory')
    name, suffix = name or path.stem, path.suffix.lower()
    is_table = suffix in TABLES and looks_like_points(path)
    if is_table or is_cloud(path) or (suffix == '.obj' and looks_like_points(path)):
        yield cloud(path, name)
    elif suffix == '.npz':
        surfel_map, scans = map_state.load_map(path)
        yield Content(name, surfel_map.moments(), surfel_map.origin_m, scans)
    elif suffix == '.parquet':
        surfel_map = parquet.read_map(path)
        yield Content(name, surfel_map.moments(), surfel_map.origin_m)
    elif suffix in TRIANGLES:
        yield Content(name, read_triangles(path))
    elif suffix in TRAJECTORIES:
        yield Content(name, read_trajectory(path))
    elif suffix == '.ply' and (mesh := ply.read_mesh(path)) is not None:
        yield Content(name, mesh)
    elif suffix in CLOUDS:
        yield cloud(path, name)
    else:
        raise FileFormatError(
            f'{path}: expected a bag, a folder, or a file ending in '
            f'{", ".join(dict.fromkeys([*EXACT, *CLOUDS, *TRIANGLES, *TRAJECTORIES]))}'
        )


def in_directory(path: Path, name: str) -> Iterator[Content]:
    """Yield the latest map in a directory and the meshes, models and trajectories beside it."""
    prefix = f'{name}/' if name else ''
    map_path = map_in(path, DRAWABLE)
    if map_path is not None and map_path.is_dir():
        surfel_map = read_tiles(map_path)
        yield Content(f'{prefix}surfels', surfel_map.moments(), surfel_map.origin_m)
    elif map_path is not None:
        yield from contents(map_path, f'{prefix}surfels')
    for file_name in BESIDE:
        if (path / file_name).is_file():
            yield from contents(path / file_name, f'{prefix}{Path(file_name).stem}')
    for apart in sorted(path.glob('apart_*.npz')):
        yield from contents(apart, f'{prefix}{apart.stem}')


def cloud(path: Path, name: str) -> Content:
    """Return the surfels or points of a file, in the fixed frame."""
    points, columns = read_scan(path)
    position = points.astype(np.float64)
    if normals_in(columns) is None:
        return Content(name, position[np.isfinite(position).all(axis=1)])
    return Content(name, discs_of(position, columns))


def discs_of(position: Array, columns: Mapping[str, npt.NDArray[Any]]) -> DrawnDiscs:
    """
    Return the discs of surfels of a file or topic; those without a radius get that of the gaps.

    Parameters
    ----------
    position : (N, 3) float64, m
        Positions, in any frame.
    columns : mapping of str to (N,) array
        With normals; rows without one are left out. The others become values.

    """
    normal = normals_in(columns)
    assert normal is not None, 'the caller has found normals'
    length = np.sqrt((normal * normal).sum(axis=1))
    is_known = np.isfinite(position).all(axis=1) & (length > 0.0)
    normal = normal[is_known] / length[is_known, None]
    position = position[is_known]
    if 'radius' in columns:
        radius_m = SPREAD * columns['radius'][is_known].astype(np.float64)
    else:
        radius_m = np.full(len(position), 0.75 * spacing_m(position))
    values = {k: v for k, v in with_one_colour(columns).items() if k not in COORDINATES}
    if 'rgb' in values:
        values |= zip(RGB, values.pop('rgb').T, strict=True)
    shown = {name: value[is_known] for name, value in values.items() if value.ndim == 1}
    return DrawnDiscs(position, normal, radius_m, shown)


def spacing_m(position: Array) -> float:
    """Return the median distance of points to their nearest neighbour, m; 0.05 for one point."""
    from scipy.spatial import cKDTree

    if len(position) < 2:
        return 0.05
    asked = position[:: max(len(position) // NEIGHBOURS, 1)]
    distance, _ = cKDTree(position).query(asked, k=2)
    return max(float(np.median(distance[:, 1])), 1e-3)
