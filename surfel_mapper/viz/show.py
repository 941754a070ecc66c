# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Show: puts maps, clouds, meshes and trajectories of files into a scene.

All of them share one frame, whose origin in the fixed frame is that of the first map, or a round
place near the first content that lies far from zero: float32, in which rerun draws, resolves
0.5 m at the northings of UTM.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.ages import Ages, ages_s
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.tsdf.mesh import Mesh
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
) -> Shown:
    """
    Show contents, and return a sentence about each.

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
    tiled = [RefinedMap(content, min_points, origin_m, shares) for content in maps]
    tiles = [refined.refine(looked_at) for refined in tiled]
    clouds = [
        shifted_cloud(content, origin_m) for content in contents if isinstance(content, Cloud)
    ]
    drawn = [discs for by_path in tiles for discs in by_path.values()]
    drawn += [cloud.discs for cloud in clouds if cloud.discs is not None]
    if any(map(len, drawn)):
        scene.colouring = Colouring.over(colouring, drawn)
    positions = [discs.position for discs in drawn] + [cloud.position for cloud in clouds]
    box = box_of(positions if any(map(len, positions)) else vertices(contents, origin_m))
    meshes = [f'map/{content.name}' for content in contents if isinstance(content, ShownMesh)]
    hidden = meshes if any(map(len, drawn)) and isinstance(scene, Scene) else []
    scene.look(*box, looked_at, hidden)
    if scene.is_watched:  # a first picture, while the rest is on its way
        log([refined.coarsest() for refined in tiled], scene)
        scene.flush()
    log(tiles, scene)
    about = {refined.name: refined.about() for refined in tiled}
    for cloud in clouds:
        about[cloud.name] = show_cloud(scene, cloud)
    for content in contents:
        if isinstance(content, ShownMesh):
            path = f'map/{content.name}'
            scene.mesh(path, shifted_mesh(content.mesh, origin_m), static=True)
            about[content.name] = f'{len(content.mesh):,} triangles'
            if path in hidden:  # it would flicker through the discs on the same surfaces
                about[content.name] += ', hidden: its eye in the panel of the viewer shows them'
        elif isinstance(content, Way):
            about[content.name] = show_way(scene, content, origin_m)
    scene.flush()
    return Shown(about, tiled)


class Shown:
    """
    Contents in a scene.

    Attributes
    ----------
    about : dict of str to str
        A sentence about each content, by name.

    """

    def __init__(self, about: dict[str, str], tiled: list[RefinedMap]) -> None:
        self.about = about
        self._tiled = tiled

    @property
    def is_coarse(self) -> bool:
        """Whether some tiles are shown by larger voxels, so that another place has other ones."""
        return any(refined.level.any() for refined in self._tiled)

    def look(self, scene: Scene, target: npt.ArrayLike) -> int:
        """
        Give another target the full detail; return the number of tiles of a changed level.

        Parameters
        ----------
        scene : Scene
            Where the contents are shown.
        target : (3,) float, m
            In the frame of the scene.

        """
        changed = [refined.refine(np.asarray(target, np.float64)) for refined in self._tiled]
        log(changed, scene)
        scene.flush()
        return sum(map(len, changed))


class RefinedMap:
    """
    A map in the tiles of its detail, and the levels at which they are shown.

    Parameters
    ----------
    shown : ExactMap
        The map.
    min_points : int
        Voxels with fewer points are not shown.
    origin_m : (3,) float64, m
        Origin of the scene in the fixed frame.
    most_discs : int
        Limit of its discs.

    """

    def __init__(self, shown: ExactMap, min_points: int, origin_m: Array, most_discs: int) -> None:
        self.name = shown.name
        self._shown, self._most_discs = shown, most_discs
        self._shift = shown.origin_m - origin_m
        self._whole = DetailedMap(shown.moments, min_points)
        self.level: npt.NDArray[np.int64] = np.full(len(self._whole), -1)

    def refine(self, target: Array) -> dict[str, DrawnDiscs]:
        """Return the discs of tiles of a changed level for a target, nearest first, by path."""
        whole = self._whole
        level = whole.choose(target - self._shift, self._most_discs)
        tiles = whole.nearest_first(np.flatnonzero(level != self.level), target - self._shift)
        self.level = level
        return self._discs(tiles)

    def coarsest(self) -> dict[str, DrawnDiscs]:
        """Return the discs of all tiles at the last level, by path, for a first picture."""
        return self._discs(np.arange(len(self._whole)), len(self._whole.counts) - 1)

    def _discs(
        self, tiles: npt.NDArray[np.int64], level: int | None = None
    ) -> dict[str, DrawnDiscs]:
        """Return the discs of tiles by path, at one level or each at its own."""
        whole, by_path = self._whole, {}
        levels = self.level if level is None else np.full_like(self.level, level)
        for tile, surfels in zip(tiles, whole.all_surfels(levels, tiles), strict=True):
            i, j = whole.tiles[tile]
            discs = with_age(surfels, self._shown, int(levels[tile]))
            values = {**discs.values, 'level': np.full(len(discs), levels[tile])}
            name = f'tile_{i}_{j}'.replace('-', 'm')
            by_path[f'map/{self.name}/{name}'] = DrawnDiscs(
                discs.position + self._shift, discs.normal, discs.radius_m, values
            )
        return by_path

    def about(self) -> str:
        """Return a sentence about the map."""
        counts, size_m = self._whole.counts, self._shown.moments.voxel_size_m
        about = f'{counts[0].sum():,} surfels in voxels of {size_m:g} m'
        if self.level.any():
            drawn = counts[self.level, np.arange(len(self._whole))].sum()
            about += f', shown as {drawn:,} on levels {self.level.min()} to {self.level.max()}'
        return about


def log(tiles: Sequence[Mapping[str, DrawnDiscs]], scene: Scene | GltfScene) -> None:
    """Show tiles of maps, each in place of its earlier discs."""
    for by_path in tiles:
        for path, discs in by_path.items():
            scene.discs(path, discs, static=True)


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
    for content in contents:
        if isinstance(content, ExactMap):
            return content.origin_m
    middle = place_of(contents)
    if np.abs(middle).max() < FAR_M:
        return np.zeros(3)
    return np.asarray(ROUND_M * np.round(middle / ROUND_M), np.float64)


def place_of(contents: Sequence[Content]) -> Array:
    """Return a place worth looking at in the fixed frame, (3,) m."""
    ways = [content.trajectory.xyz for content in contents if isinstance(content, Way)]
    if ways and len(ways[0]):
        return np.asarray(ways[0][-1], np.float64)
    for content in contents:
        if isinstance(content, ExactMap) and len(content.moments):
            return content.middle()
        points = content.position if isinstance(content, Cloud) else None
        points = content.mesh.vertices if isinstance(content, ShownMesh) else points
        if points is not None and len(points):
            return np.asarray(np.median(points, axis=0), np.float64)
    return np.zeros(3)


def vertices(contents: Sequence[Content], origin_m: Array) -> list[Array]:
    """Return the vertices of meshes and the positions of trajectories, (N, 3) m each."""
    meshes = [content.mesh.vertices for content in contents if isinstance(content, ShownMesh)]
    ways = [content.trajectory.xyz for content in contents if isinstance(content, Way)]
    return [xyz - origin_m for xyz in (*meshes, *ways)]


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
