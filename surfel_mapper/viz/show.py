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

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.ages import Ages, ages_s
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.contents import Asset, Cloud, Content, ExactMap, ShownMesh, Way
from surfel_mapper.viz.detail import DetailedMap
from surfel_mapper.viz.discs import Colouring, DrawnDiscs
from surfel_mapper.viz.gltf import GltfScene
from surfel_mapper.viz.scene import ORANGE, RED, Scene

Array = npt.NDArray[np.float64]

MOST_DISCS = 250_000
"""Limit of the discs of all maps together: 70 MB in the viewer, fluid without a graphics card."""

FAR_M = 10_000.0
"""Coordinates beyond this are shown about an origin; float32 resolves 1 mm there."""

ROUND_M = 1000.0
"""The origin of contents without one is a multiple of this."""


def show_contents(
    scene: Scene | GltfScene,
    contents: Sequence[Content],
    *,
    colouring: str = 'normal',
    place: npt.ArrayLike | None = None,
    most_discs: int = MOST_DISCS,
    min_points: int = 5,
) -> dict[str, str]:
    """
    Show contents; return a sentence about each by name.

    Parameters
    ----------
    scene : Scene or GltfScene
        Where they are shown.
    contents : sequence of Content
        As ``contents`` of contents.py yields them.
    colouring : str
        One of discs.COLOURINGS.
    place : (3,) float, m, optional
        The place looked at, in the fixed frame; around it maps have their full detail. Default:
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
    looked_at = np.asarray(place_of(contents) if place is None else place, np.float64) - origin_m
    maps = [each for each in contents if isinstance(each, ExactMap)]
    shares = most_discs // max(len(maps), 1)
    tiled = [detailed(each, min_points, looked_at, origin_m, shares) for each in maps]
    clouds = [shifted_cloud(each, origin_m) for each in contents if isinstance(each, Cloud)]
    parts = [part for tiles in tiled for part in tiles.discs.values()]
    parts += [each.discs for each in clouds if each.discs is not None]
    if any(map(len, parts)):
        scene.colouring = Colouring.over(colouring, parts)
    box = box_of([part.position for part in parts] + [each.position for each in clouds])
    scene.look(*box, looked_at)
    about = {}
    for found in tiled:
        for tile, discs in found.discs.items():
            scene.discs(f'map/{found.name}/{tile}', discs, static=True)
        about[found.name] = found.about
    for each in clouds:
        about[each.name] = show_cloud(scene, each)
    for other in contents:
        if isinstance(other, ShownMesh):
            scene.mesh(f'map/{other.name}', shifted_mesh(other.mesh, origin_m), static=True)
            about[other.name] = f'{len(other.mesh):,} triangles'
        elif isinstance(other, Asset):
            scene.asset(f'map/{other.name}', other.path)
            about[other.name] = 'triangles as rerun reads them'
        elif isinstance(other, Way):
            about[other.name] = show_way(scene, other, origin_m)
    scene.flush()
    return about


class Tiles:
    """The discs of a map by tile, and a sentence about them."""

    def __init__(self, name: str, discs: dict[str, DrawnDiscs], about: str) -> None:
        self.name, self.discs, self.about = name, discs, about


def detailed(
    shown: ExactMap, min_points: int, place: Array, origin_m: Array, most_discs: int
) -> Tiles:
    """Return the discs of a map by tile, fine near a place of the shared frame."""
    shift = shown.origin_m - origin_m
    whole = DetailedMap(shown.moments, min_points)
    level = whole.choose(place - shift, most_discs)
    found = {}
    every = zip(whole.tiles, level, whole.all_surfels(level), strict=True)
    for (i, j), each_level, surfels in every:
        discs = with_age(surfels, shown, int(each_level))
        name = f'tile_{i}_{j}'.replace('-', 'm')
        values = {**discs.values, 'level': np.full(len(discs), each_level)}
        found[name] = DrawnDiscs(discs.position + shift, discs.normal, discs.radius_m, values)
    drawn = sum(map(len, found.values()))
    total = int(whole.counts[0].sum())
    about = f'{total:,} surfels in voxels of {shown.moments.voxel_size_m:g} m'
    if level.any():
        about += f', shown as {drawn:,} on levels {level.min()} to {level.max()}'
    return Tiles(shown.name, found, about)


def with_age(surfels: Surfels, shown: ExactMap, level: int) -> DrawnDiscs:
    """Return surfels as discs, with their ages if the map has the scans of its window."""
    if not shown.scans or level:
        return DrawnDiscs.of(surfels)
    newest_ns = max(scan.stamp_ns for scan in shown.scans)
    seen_ns = Ages().last_seen_ns(surfels.voxel_index, shown.scans)
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
    for each in contents:
        if isinstance(each, ExactMap):
            return each.origin_m
    middle = place_of(contents)
    if np.abs(middle).max() < FAR_M:
        return np.zeros(3)
    return np.asarray(ROUND_M * np.round(middle / ROUND_M), np.float64)


def place_of(contents: Sequence[Content]) -> Array:
    """Return a place worth looking at in the fixed frame, (3,) m."""
    ways = [each.trajectory.xyz for each in contents if isinstance(each, Way)]
    if ways and len(ways[0]):
        return np.asarray(ways[0][-1], np.float64)
    for each in contents:
        if isinstance(each, ExactMap) and len(each.moments):
            return each.middle()
        points = each.position if isinstance(each, Cloud) else None
        points = each.mesh.vertices if isinstance(each, ShownMesh) else points
        if points is not None and len(points):
            return np.asarray(np.median(points, axis=0), np.float64)
    return np.zeros(3)


def box_of(places: Sequence[Array]) -> tuple[Array, Array]:
    """Return the box with all but the farthest of some places, (3,) m each."""
    every = np.concatenate(places) if places else np.empty((0, 3))
    if not len(every):
        return np.full(3, -10.0), np.full(3, 10.0)
    low, high = np.percentile(every, [1.0, 99.0], axis=0)
    return low, high


def shifted_cloud(cloud: Cloud, origin_m: Array) -> Cloud:
    """Return a cloud about an origin."""
    discs = cloud.discs
    if discs is not None:
        position = discs.position - origin_m
        discs = DrawnDiscs(position, discs.normal, discs.radius_m, discs.values)
    return Cloud(cloud.name, cloud.position - origin_m, discs)


def shifted_mesh(mesh: Mesh, origin_m: Array) -> Mesh:
    """Return a mesh about an origin."""
    return Mesh(
        vertices=mesh.vertices - origin_m,
        triangles=mesh.triangles,
        colors=mesh.colors,
        labels=mesh.labels,
    )
