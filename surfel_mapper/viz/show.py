# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Show: puts maps, clouds, meshes and trajectories of files into a scene.

All of them share one frame, whose origin in the fixed frame is that of the first map, or a round
place near the first content that lies far from zero: float32, in which rerun draws, resolves
0.5 m at the northings of UTM.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import counted
from surfel_mapper.files.trajectory import Trajectory
from surfel_mapper.mapping.channels import CHANNELS
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.contents import Content
from surfel_mapper.viz.detail import DetailedMap
from surfel_mapper.viz.discs import Colouring, DrawnDiscs
from surfel_mapper.viz.framing import levelled
from surfel_mapper.viz.scene import ORANGE, POINT_RADIUS_M, RED, Scene, SENSOR_RADIUS

Array = npt.NDArray[np.float64]

MOST_DISCS = 250_000
"""
Limit of the discs of all maps together: 70 MB in the viewer, a million triangles.

Two cores without a graphics card draw a picture of 213,688 discs in 2.6 s, of 20,000 in 1.5.
"""

FAR_M = 10_000.0
"""Coordinates beyond this are shown about an origin; float32 resolves 1 mm there."""

ROUND_M = 1000.0
"""The origin of contents without one is a multiple of this."""


def show_contents(
    scene: Scene,
    contents: Sequence[Content],
    *,
    colouring: str = 'normal',
    target: npt.ArrayLike | None = None,
    most_discs: int = MOST_DISCS,
    min_points: int = 5,
) -> dict[str, str]:
    """
    Show contents, and return a sentence about each, by name.

    Parameters
    ----------
    scene : Scene
        Where they are shown.
    contents : sequence of Content
        As ``contents`` of contents.py yields them.
    colouring : str
        One of discs.COLOURINGS.
    target : (3,) float, m, optional
        The position looked at, in the fixed frame. Maps have their full detail around it. Default:
        the end of the first trajectory, else the middle of the first map.
    most_discs : int
        Limit of the discs of all maps together.
    min_points : int
        Voxels of maps with fewer points are not shown.

    Raises
    ------
    ConfigError
        If there is no such colouring, or nothing shown has its value.

    """
    origin_m = shared_origin(contents)
    scene.set_origin(origin_m)
    looked_at = np.asarray(place_of(contents) if target is None else target, np.float64) - origin_m
    with_ages = colouring == 'age'
    tiles, about = all_discs(contents, origin_m, looked_at, (most_discs, min_points, with_ages))
    if any(map(len, tiles.values())):
        scene.colouring = Colouring.over(colouring, list(tiles.values()))
    positions = [discs.position for discs in tiles.values()]
    positions += [c.shape - origin_m for c in contents if isinstance(c.shape, np.ndarray)]
    if not any(map(len, positions)):
        positions = [content.positions() - origin_m for content in contents]
    meshes = [f'map/{content.name}' for content in contents if isinstance(content.shape, Mesh)]
    hidden = meshes if any(map(len, tiles.values())) else []
    level = levelled(max(tiles.values(), key=len)) if tiles else np.eye(3)
    scene.look(*box_of(positions), looked_at, level, hidden)
    for path, discs in tiles.items():
        scene.discs(path, discs, static=True)
    for content in contents:
        path, shape = f'map/{content.name}', content.shape
        if isinstance(shape, np.ndarray):
            points = scene.rerun.Points3D(shape - origin_m, radii=POINT_RADIUS_M)
            scene.log(path, points, static=True)
            about[content.name] = counted(len(shape), 'point')
        elif isinstance(shape, Mesh):
            scene.mesh(path, replace(shape, vertices=shape.vertices - origin_m), static=True)
            about[content.name] = counted(len(shape), 'triangle')
            if path in hidden:  # it would flicker through the discs on the same surfaces
                about[content.name] += ', hidden: its eye in the panel of the viewer shows them'
        elif isinstance(shape, Trajectory):
            about[content.name] = show_way(scene, path, shape, origin_m)
    scene.flush()
    return about


def all_discs(
    contents: Sequence[Content], origin_m: Array, target: Array, limits: tuple[int, int, bool]
) -> tuple[dict[str, DrawnDiscs], dict[str, str]]:
    """
    Return the discs of maps and surfels by path, and a sentence about each by name.

    Parameters
    ----------
    contents : sequence of Content
        The maps and surfels; others are passed over.
    origin_m, target : (3,) float64, m
        Origin of the scene in the fixed frame, and the position looked at in the scene.
    limits : (int, int, bool)
        Limit of the discs of all maps, least points of a voxel, and whether ages are shown, which
        voxels have and adaptive surfels do not.

    """
    most_discs, min_points, with_ages = limits
    num_maps = sum(isinstance(content.shape, ScanMoments) for content in contents)
    tiles: dict[str, DrawnDiscs] = {}
    about: dict[str, str] = {}
    for content in contents:
        shape, shift_m = content.shape, content.origin_m - origin_m
        if isinstance(shape, ScanMoments):
            whole = DetailedMap(shape, min_points)
            level = whole.choose(target - shift_m, most_discs // num_maps)
            about[content.name] = map_text(whole, level, shape.voxel_size_m)
            if level.any() or with_ages or shape.level:
                tiles.update(map_tiles(content, whole, level, shift_m))
            else:
                discs = adaptive_discs(shape, min_points)
                tiles[f'map/{content.name}'] = moved(discs, shift_m)
                about[content.name] += f', shown as {len(discs):,} adaptive ones'
        elif isinstance(shape, DrawnDiscs):
            tiles[f'map/{content.name}'] = moved(shape, shift_m)
            about[content.name] = f'{counted(len(shape), "surfel")} without their moments'
    return tiles, about


def adaptive_discs(moments: ScanMoments, min_points: int) -> DrawnDiscs:
    """Return the adaptive surfels of the moments of a map as discs, in the frame of the map."""
    has = [name for name, channels in CHANNELS.items() if channels[0] in moments.channel_names]
    surfel_map = SurfelMap(moments.voxel_size_m, columns=tuple(has))
    surfel_map.insert(moments)
    return DrawnDiscs.of(surfel_map.adaptive(min_points), [])


def moved(discs: DrawnDiscs, shift_m: Array) -> DrawnDiscs:
    """Return discs in the frame of the scene, which is that of the map shifted."""
    return replace(discs, position=discs.position + shift_m, grid_m=shift_m)


def map_tiles(
    content: Content, whole: DetailedMap, level: npt.NDArray[np.int64], shift_m: Array
) -> dict[str, DrawnDiscs]:
    """Return the discs of the tiles of a map, each at its level, in the frame of the scene."""
    tiles = {}
    for tile, surfels in enumerate(whole.all_surfels(level)):
        name = 'tile_{}_{}'.format(*whole.tiles[tile]).replace('-', 'm')
        discs = DrawnDiscs.of(surfels, [] if level[tile] else content.scans)
        values = {**discs.values, 'level': np.full(len(discs), level[tile])}
        tiles[f'map/{content.name}/{name}'] = moved(replace(discs, values=values), shift_m)
    return tiles


def map_text(whole: DetailedMap, level: npt.NDArray[np.int64], voxel_size_m: float) -> str:
    """Return a sentence about a map and the levels that are shown."""
    text = f'{counted(whole.counts[0].sum(), "surfel")} in voxels of {voxel_size_m:g} m'
    if level.any():
        drawn = whole.counts[level, np.arange(len(whole))].sum()
        text += f', shown as {drawn:,} on levels {level.min()} to {level.max()}'
    return text


def show_way(scene: Scene, path: str, poses: Trajectory, origin_m: Array) -> str:
    """Show a trajectory as a line, and as a sensor that moves if it has stamps."""
    xyz = poses.xyz - origin_m
    line = scene.rerun.LineStrips3D([xyz], colors=[RED])
    scene.log(path, line, static=True)
    if poses.stamp_ns is None or not len(poses):
        return f'{counted(len(poses), "pose")} without stamps'
    scene.poses(f'{path}/sensor', poses.stamp_ns, xyz, poses.q_xyzw)
    sensor = scene.rerun.Points3D(np.zeros((1, 3)), radii=SENSOR_RADIUS, colors=[ORANGE])
    scene.log(f'{path}/sensor', sensor, static=True)
    return f'{counted(len(poses), "pose")} over {np.ptp(poses.stamp_ns) / 1e9:.1f} s'


def shared_origin(contents: Sequence[Content]) -> Array:
    """Return the origin of the shared frame in the fixed frame, (3,) m."""
    for content in contents:
        if isinstance(content.shape, ScanMoments):
            return content.origin_m
    centre = place_of(contents)
    if np.abs(centre).max() < FAR_M:
        return np.zeros(3)
    return np.asarray(ROUND_M * np.round(centre / ROUND_M), np.float64)


def place_of(contents: Sequence[Content]) -> Array:
    """Return a place worth looking at in the fixed frame, (3,) m."""
    ways = [c.shape.xyz for c in contents if isinstance(c.shape, Trajectory)]
    if ways and len(ways[0]):
        return np.asarray(ways[0][-1], np.float64)
    filled = [positions for positions in map(Content.positions, contents) if len(positions)]
    return np.asarray(np.median(filled[0], axis=0) if filled else np.zeros(3), np.float64)


def box_of(positions: Sequence[Array]) -> tuple[Array, Array]:
    """Return the box with all but the farthest of some positions, (3,) m each."""
    every = np.concatenate(positions) if positions else np.empty((0, 3))
    if not len(every):
        return np.full(3, -10.0), np.full(3, 10.0)
    low, high = np.percentile(every, [1.0, 99.0], axis=0)
    return low, high
