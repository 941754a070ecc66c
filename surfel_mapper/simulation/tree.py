# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A tree of axis-parallel bounding boxes over primitives.

Every node holds one box; a leaf holds one primitive. Nodes stand in depth-first order, so the
node after an entered one is its successor, and after a missed one the end of its branch. Halves
are split at the median of the centres along the longer side, which keeps the tree balanced
whatever the world looks like.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

MARGIN = 1e-9
"""Boxes are wider by this share of the largest coordinate: rounding never hides a surface."""


@dataclass(frozen=True, slots=True)
class BoxTree:
    """
    The nodes in depth-first order.

    Attributes
    ----------
    box : (M, 6) float64, m
        Lowest x y z, highest x y z.
    next : (M,) int64
        The node after this one's whole branch.
    primitive : (M,) int64
        The primitive of a leaf, -1 elsewhere.

    """

    box: npt.NDArray[np.float64]
    next: npt.NDArray[np.int64]
    primitive: npt.NDArray[np.int64]


def bounding_boxes(
    pose: npt.NDArray[np.float64], half: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return (P, 6) float64 boxes about primitives from (P, 3, 4) poses and (P, 3) half sizes."""
    centre = pose[:, :, 3]
    reach = (np.abs(pose[:, :, :3]) * half[:, None, :]).sum(axis=2)
    reach += MARGIN * np.abs(centre).max(axis=1, initial=1.0, keepdims=True) + MARGIN * reach
    return np.concatenate([centre - reach, centre + reach], axis=1)


def build_tree(boxes: npt.NDArray[np.float64]) -> BoxTree:
    """Return the tree over (P, 6) bounding boxes; without boxes it has no node."""
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
    """Write the branch of some primitives from a node on; return the node after it."""
    inside = boxes[members]
    tree.box[node, :3] = inside[:, :3].min(axis=0)
    tree.box[node, 3:] = inside[:, 3:].max(axis=0)
    after = node + 2 * len(members) - 1
    tree.next[node] = after
    if len(members) == 1:
        tree.primitive[node] = members[0]
        return after
    centres = inside[:, :3] + inside[:, 3:]
    axis = int(np.argmax(np.ptp(centres, axis=0)))
    order = members[np.argsort(centres[:, axis], kind='stable')]
    middle = _fill(tree, boxes, order[: len(order) // 2], node + 1)
    return _fill(tree, boxes, order[len(order) // 2 :], middle)
