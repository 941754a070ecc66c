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

from surfel_mapper.mapping.ages import ages_s, last_seen_ns
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.viz.contents import Cloud, Content, ExactMap, ShownMesh, Way
from surfel_mapper.viz.detail import DetailedMap
from surfel_mapper.viz.discs import Colouring, DrawnDiscs
from surfel_mapper.viz.gltf import GltfScene
from surfel_mapper.viz.scene import ORANGE, RED, Scene

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
    scene: Scene | GltfScene,
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
    scene : Scene or GltfScene
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
    maps = [content for content in contents if isinstance(content, ExactMap)]
    shares = most_discs // max(len(maps), 1)
    tiles: dict[str, DrawnDiscs] = {}
    about: dict[str, str] = {}
    for exact in maps:
        shift_m = exact.origin_m - origin_m
        by_path, about[exact.name] = map_tiles(
            exact, min_points, shift_m, looked_at - shift_m, shares
        )
        tiles.update(by_path)
    clouds = [
        shifted_cloud(content, origin_m) for content in contents if isinstance(content, Cloud)
    ]
    drawn = list(tiles.values())
    drawn += [cloud.discs for cloud in clouds if cloud.discs is not None]
    if any(map(len, drawn)):
        scene.colouring = Colouring.over(colouring, drawn)
    positions = [discs.position for discs in drawn] + [cloud.position for cloud in clouds]
    if not any(map(len, positions)):
        positions = [positions_of(content) - origin_m for content in contents]
    box = box_of(positions)
    meshes = [f'map/{content.name}' for content in contents if isinstance(content, ShownMesh)]
    hidden = meshes if any(map(len, drawn)) and isinstance(scene, Scene) else []
    scene.look(*box, looked_at, hidden)
    for path, discs in tiles.items():
        scene.discs(path, discs, static=True)
    for cloud in clouds:
        about[cloud.name] = show_cloud(scene, cloud)
    for content in contents:
        if isinstance(content, ShownMesh):
            path = f'map/{content.name}'
            mesh = replace(content.mesh, vertices=content.mesh.vertices - origin_m)
            scene.mesh(path, mesh, static=True)
            about[content.name] = f'{len(content.mesh):,} triangles'
            if path in hidden:  # it would flicker through the discs on the same surfaces
                about[content.name] += ', hidden: its eye in the panel of the viewer shows them'
        elif isinstance(content, Way):
            about[content.name] = show_way(scene, content, origin_m)
    scene.flush()
    return about


def map_tiles(
    shown: ExactMap, min_points: int, shift_m: Array, target: Array, most_discs: int
) -> tuple[dict[str, DrawnDiscs], str]:
    """
    Return the discs of a map in tiles, by path, finest about a target, and a sentence about it.

    Parameters
    ----------
    shown : ExactMap
        The map.
    min_points : int
        Voxels with fewer points are not shown.
    shift_m : (3,) float64, m
        Origin of the map in the frame of the scene.
    target : (3,) float64, m
        Place looked at, in the frame of the map.
    most_discs : int
        Limit of its discs.

    """
    whole = DetailedMap(shown.moments, min_points)
    level = whole.choose(target, most_discs)
    tiles = {}
    for tile, surfels in enumerate(whole.all_surfels(level)):
        i, j = whole.tiles[tile]
        discs = with_age(surfels, shown, int(level[tile]))
        values = {**discs.values, 'level': np.full(len(discs), level[tile])}
        name = f'tile_{i}_{j}'.replace('-', 'm')
        moved = replace(discs, position=discs.position + shift_m, values=values)
        tiles[f'map/{shown.name}/{name}'] = moved
    about = f'{whole.counts[0].sum():,} surfels in voxels of {shown.moments.voxel_size_m:g} m'
    if level.any():
        drawn = whole.counts[level, np.arange(len(whole))].sum()
        about += f', shown as {drawn:,} on levels {level.min()} to {level.max()}'
    return tiles, about


def with_age(surfels: Surfels, shown: ExactMap, level: int) -> DrawnDiscs:
    """Return surfels as discs, with their ages if the map has the scans of its window."""
    if not shown.scans or level:
        return DrawnDiscs.of(surfels)
    newest_ns = max(scan.stamp_ns for scan in shown.scans)
    seen_ns = last_seen_ns(surfels.voxel_index, shown.scans)
    return DrawnDiscs.of(surfels, {'age': ages_s(seen_ns, newest_ns)})


def show_cloud(scene: Scene | GltfScene, cloud: Cloud) -> str:
    """Show surfels of a file as discs, or points."""
    path = f'map/{cloud.name}'
    if cloud.discs is None:
        scene.points(path, cloud.position, 0.02, static=True)
        return f'{len(cloud.position):,} points'
    scene.discs(path, cloud.discs, static=True)
    return f'{len(cloud.discs):,} surfels, without their moments: at one level of detail'


def show_way(scene: Scene | GltfScene, way: Way, origin_m: Array) -> str:
    """Show a trajectory as a line, and as a sensor that moves if it has stamps."""
    poses = way.trajectory
    xyz = poses.xyz - origin_m
    scene.lines(f'map/{way.name}', [xyz], [RED], static=True)
    if poses.stamp_ns is None or not len(poses):
        return f'{len(poses)} poses without stamps'
    path = f'map/{way.name}/sensor'
    scene.poses(path, poses.stamp_ns, xyz, poses.q_xyzw)
    scene.points(path, np.zeros((1, 3)), 0.3, ORANGE, static=True)
    return f'{len(poses)} poses over {(poses.stamp_ns[-1] - poses.stamp_ns[0]) / 1e9:.1f} s'


def shared_origin(contents: Sequence[Content]) -> Array:
    """Return the origin of the shared frame in the fixed frame, (3,) m."""
    for content in contents:
        if isinstance(content, ExactMap):
            return content.origin_m
    middle = place_of(contents)
    if np.abs(middle).max() < FAR_M:
        return np.zeros(3)
    return np.asarray(ROUND_M * np.round(middle / ROUND_M), np.float64)


def positions_of(content: Content) -> Array:
    """Return the positions of a content in the fixed frame, (N, 3) m."""
    if isinstance(content, ExactMap):
        return content.middles()
    if isinstance(content, ShownMesh):
        return content.mesh.vertices
    return content.trajectory.xyz if isinstance(content, Way) else content.position


def place_of(contents: Sequence[Content]) -> Array:
    """Return a place worth looking at in the fixed frame, (3,) m."""
    ways = [content.trajectory.xyz for content in contents if isinstance(content, Way)]
    if ways and len(ways[0]):
        return np.asarray(ways[0][-1], np.float64)
    filled = [positions for positions in map(positions_of, contents) if len(positions)]
    return np.asarray(np.median(filled[0], axis=0) if filled else np.zeros(3), np.float64)


def box_of(positions: Sequence[Array]) -> tuple[Array, Array]:
    """Return the box with all but the farthest of some positions, (3,) m each."""
    every = np.concatenate(positions) if positions else np.empty((0, 3))
    if not len(every):
        return np.full(3, -10.0), np.full(3, 10.0)
    low, high = np.percentile(every, [1.0, 99.0], axis=0)
    return low, high


def shifted_cloud(cloud: Cloud, origin_m: Array) -> Cloud:
    """Return a cloud about an origin."""
    discs = cloud.discs
    if discs is not None:
        discs = replace(discs, position=discs.position - origin_m)
    return Cloud(cloud.name, cloud.position - origin_m, discs)
