# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
World: analytic primitives for ray casting, with the true surface and normal at any position.

A surface is a number: a plane, the side of a cylinder, a sphere. The six faces of a box are six
surfaces, which distinguishes points on one plane from points on one object.

Primitives are the leaves of a tree of axis-parallel bounding boxes in depth-first order: after an
entered node comes the next one, after a missed node the end of its branch. Nodes are split at the
median of the centres along the longest side, which keeps the tree balanced for any world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
import json
from pathlib import Path

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import read_small_file
from surfel_mapper.errors import refusing
from surfel_mapper.files.atomic import write_json
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.simulation.kernels import raycast, surfaces
from surfel_mapper.simulation.primitives import KINDS, Primitive
from surfel_mapper.simulation.street import street_pose, street_primitives

MARGIN = 1e-9
"""Margin of boxes relative to the largest coordinate, so that rounding never hides a surface."""


@dataclass(frozen=True, slots=True)
class BoxTree:
    """
    A tree of bounding boxes: its nodes in depth-first order.

    Attributes
    ----------
    box : (M, 6) float64, m
        Lowest x y z, highest x y z.
    next : (M,) int64
        Number of the first node after the branch of each node.
    primitive : (M,) int64
        Primitive of a leaf, -1 for inner nodes.

    """

    box: npt.NDArray[np.float64]
    next: npt.NDArray[np.int64]
    primitive: npt.NDArray[np.int64]


def bounding_boxes(
    pose: npt.NDArray[np.float64], half: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return the (P, 6) boxes, m, of primitives with (P, 3, 4) poses and (P, 3) half sizes."""
    centre = pose[:, :, 3]
    reach = (np.abs(pose[:, :, :3]) * half[:, None, :]).sum(axis=2)
    reach += MARGIN * np.abs(centre).max(axis=1, initial=1.0, keepdims=True) + MARGIN * reach
    return np.concatenate([centre - reach, centre + reach], axis=1)


def build_tree(boxes: npt.NDArray[np.float64]) -> BoxTree:
    """Return the tree over (P, 6) bounding boxes; it has no nodes without boxes."""
    num_nodes = max(2 * len(boxes) - 1, 0)
    tree = BoxTree(
        np.empty((num_nodes, 6)),
        np.empty(num_nodes, dtype=np.int64),
        np.full(num_nodes, -1, dtype=np.int64),
    )
    if num_nodes:
        _fill(tree, boxes, np.arange(len(boxes)), 0)
    return tree


def _fill(
    tree: BoxTree, boxes: npt.NDArray[np.float64], members: npt.NDArray[np.int64], node: int
) -> int:
    """Write the branch of members at a node; return the first node after it."""
    inside = boxes[members]
    tree.box[node, :3] = inside[:, :3].min(axis=0)
    tree.box[node, 3:] = inside[:, 3:].max(axis=0)
    end = node + 2 * len(members) - 1
    tree.next[node] = end
    if len(members) == 1:
        tree.primitive[node] = members[0]
        return end
    centres = inside[:, :3] + inside[:, 3:]
    axis = int(np.argmax(np.ptp(centres, axis=0)))
    order = members[np.argsort(centres[:, axis], kind='stable')]
    sibling = _fill(tree, boxes, order[: len(order) // 2], node + 1)
    return _fill(tree, boxes, order[len(order) // 2 :], sibling)


FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FORMAT = 'surfel_mapper world 1'
"""Value of the key format in the file of a world."""


class World:
    """
    A world of analytic primitives.

    Parameters
    ----------
    primitives : sequence of Primitive
        Solids may overlap; surfaces inside of other solids remain.
    start : (7,) float
        Start pose of drives, x y z (m) qx qy qz qw: on the ground, x ahead, z up.

    Raises
    ------
    ValueError
        If the start is not a pose.

    """

    def __init__(
        self,
        primitives: Sequence[Primitive],
        start: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    ) -> None:
        self.primitives = tuple(primitives)
        self.start = tuple(float(value) for value in start)
        self.T_world_start = pose_matrix(self.start[:3], self.start[3:])
        self._kind = np.array([KINDS[p.kind][0] for p in self.primitives], dtype=np.int64)
        poses = [p.T_world_primitive[:3] for p in self.primitives]
        self._pose = np.array(poses, dtype=np.float64).reshape(-1, 3, 4)
        halves = [p.half_m for p in self.primitives]
        self._half = np.array(halves, dtype=np.float64).reshape(-1, 3)
        tree = build_tree(bounding_boxes(self._pose, self._half))
        self._tables = (self._kind, self._pose, self._half, tree.box, tree.next, tree.primitive)
        self._reflectivity = np.array([p.reflectivity for p in self.primitives])

    @classmethod
    def street(cls, *, seed: int = 0, length_m: float = 200.0) -> World:
        """
        Return a street canyon, rotated against the voxel grid; deterministic.

        Parameters
        ----------
        seed : int
            Seed of the positions and rotations of objects.
        length_m : float
            Longest drive; the street continues beyond both ends.

        Raises
        ------
        ConfigError
            If the seed is negative or the length is not positive and finite.

        """
        return cls(street_primitives(seed, length_m), street_pose())

    def raycast(
        self, origins: npt.ArrayLike, directions: npt.ArrayLike, max_range_m: float = np.inf
    ) -> tuple[FloatArray, IntArray, FloatArray]:
        """
        Return the first surface on each ray.

        Parameters
        ----------
        origins : (N, 3) or (3,) float64, m
            In the world frame.
        directions : (N, 3) float64
            Unit vectors in the world.
        max_range_m : float
            Farther surfaces are ignored.

        Returns
        -------
        range_m : (N,) float64
            Distance, inf for no hit.
        surface : (N,) int64
            The surface, -1 for no hit.
        normal : (N, 3) float64
            Outward normal at the hit, nan for no hit. From inside of a solid, and from behind a
            rectangle, it points along the ray.

        """
        start = _rows(origins, 'origins')
        ahead = _rows(directions, 'directions')
        range_m = np.full(len(ahead), max_range_m, dtype=np.float64)
        surface = np.empty(len(ahead), dtype=np.int64)
        raycast.cast(start, ahead, *self._tables, range_m, surface)
        range_m[surface < 0] = np.inf
        hits = start + np.where(surface < 0, 0.0, range_m)[:, None] * ahead
        return range_m, surface, self._normals(hits, surface)

    def surface_at(self, positions: npt.ArrayLike) -> tuple[IntArray, FloatArray, FloatArray]:
        """
        Return the surface nearest to each position.

        Parameters
        ----------
        positions : (N, 3) float64, m
            In the world frame, on either side of the surface or on it.

        Returns
        -------
        surface : (N,) int64
            -1 for non-finite positions and in an empty world.
        distance_m : (N,) float64
            Distance to the surface, inf for none.
        normal : (N, 3) float64
            Outward unit normal of the surface, nan for none.

        """
        xyz = _rows(positions, 'positions')
        surface = np.empty(len(xyz), dtype=np.int64)
        distance_m = np.empty(len(xyz))
        surfaces.nearest_surface(xyz, *self._tables, distance_m, surface)
        return surface, distance_m, self._normals(xyz, surface)

    def normal_at(self, positions: npt.ArrayLike) -> FloatArray:
        """Return the (N, 3) outward normals of the surfaces nearest to (N, 3) positions, m."""
        return self.surface_at(positions)[2]

    def primitive_of(self, surface: IntArray) -> IntArray:
        """Return the index of the primitive that each surface belongs to; -1 for -1."""
        return np.where(surface < 0, -1, surface // surfaces.FACES)

    def reflectivity(self, surface: IntArray) -> FloatArray:
        """Return the reflectivity of each surface in [0, 1], nan for -1."""
        return np.append(self._reflectivity, np.nan)[self.primitive_of(surface)]

    def save(self, path: str | Path) -> None:
        """Write the world to a JSON file, atomically."""
        primitives = [asdict(primitive) for primitive in self.primitives]
        content = {'format': FORMAT, 'start': list(self.start), 'primitives': primitives}
        write_json(path, content)

    @classmethod
    def load(cls, path: str | Path) -> World:
        """
        Read a world from a file written by save.

        Raises
        ------
        FileFormatError
            If the file cannot be read or does not hold a world.

        """
        with refusing(path):
            content = json.loads(read_small_file(path))
            if content['format'] != FORMAT:
                raise ValueError(f'format: {content["format"]!r}, expected {FORMAT!r}')
            primitives = [Primitive(**entry) for entry in content['primitives']]
            return cls(primitives, content['start'])

    def _normals(self, positions: FloatArray, surface: IntArray) -> FloatArray:
        """Return the (N, 3) outward normals of surfaces at positions on or near them."""
        normals = np.empty((len(positions), 3))
        surfaces.outward_normals(positions, surface, self._kind, self._pose, normals)
        return normals


def _rows(values: npt.ArrayLike, name: str) -> FloatArray:
    """Return (N, 3) float64, contiguous; a single triple is one row."""
    rows = np.ascontiguousarray(np.atleast_2d(values), dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise ValueError(f'{name}: shape {rows.shape}, expected (N, 3)')
    return rows
