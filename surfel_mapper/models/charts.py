# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Charts: connected components of surfels, bisected until each part is a height field.

A component is bisected if its normals deviate too far from their mean, or if it overlaps itself,
as parking ramps do. The result depends on the voxels of the component only, not on its history.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.frames import mean_normals
from surfel_mapper.models.segmentation import bisected_normals, height_fields, is_folded
from surfel_mapper.models.surfel_graph import SurfelGraph

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]
Indices = npt.NDArray[np.int64]

LEAST_CURVED_VOXELS, LEAST_CURVED_POINTS = 15, 1000
"""
A curved chart has at least this number of voxels, or of points: round objects close to a camera.
Others are mostly parts of tree crowns, of which one in nine merges within a metre of a drive. With
12 voxels or 500 points fewer ids stay; with 18 voxels more objects on a table are no patches.
"""

STACKED_SHARE = 0.05
"""A chart overlaps itself if more than this share of its columns is too high."""

STACKED_VOXELS = 4.0
"""Height of a column that overlaps itself, in voxels; a slope of 60 deg is 2.5 voxels high."""


def chart_components(
    graph: SurfelGraph,
    rows: Rows,
    starts: Indices,
    angles_deg: tuple[float, float],
    least: int,
) -> list[Rows]:
    """
    Return the voxels of every chart; small curved ones are dropped.

    Parameters
    ----------
    graph : SurfelGraph
        The voxels.
    rows, starts : (M,) int32, (K + 1,) int64
        Components: k has rows starts[k] to starts[k + 1] - 1.
    angles_deg : (float, float)
        Largest angle between a normal and the mean of its chart; between normals of a flat one.
    least : int
        Charts of fewer voxels are dropped.

    """
    means, fold = mean_normals(graph.normal[rows], starts), math.cos(math.radians(angles_deg[0]))
    axis = np.repeat(means, np.diff(starts), axis=0)
    cosine = np.einsum('ij,ij->i', graph.normal[rows], axis)
    height = np.einsum('ij,ij->i', graph.position[rows], axis)
    extent = np.maximum.reduceat(height, starts[:-1]) - np.minimum.reduceat(height, starts[:-1])
    doubtful = np.minimum.reduceat(cosine, starts[:-1]) < fold
    doubtful |= extent > STACKED_VOXELS * graph.map.voxel_size_m
    charts: list[Rows] = []
    for k in range(len(means)):
        members = rows[starts[k] : starts[k + 1]]
        if doubtful[k]:
            ordered = members[np.argsort(graph.key[members])]
            charts += bisected(graph, ordered, fold, least)
        else:
            charts.append(members)
    limit = math.cos(math.radians(angles_deg[1]))
    return [chart for chart in charts if not is_small_curved(graph, chart, limit)]


def is_small_curved(graph: SurfelGraph, chart: Rows, limit: float) -> bool:
    """Return whether a chart is curved, by cosines of its normals, and too small to be kept."""
    if len(chart) >= LEAST_CURVED_VOXELS or graph.count[chart].sum() >= LEAST_CURVED_POINTS:
        return False
    normals = graph.normal[chart]  # of either sign
    return bool(np.abs(normals @ normals.T).min() < limit)


def bisected(graph: SurfelGraph, members: Rows, limit: float, least: int) -> list[Rows]:
    """Return the charts of one component whose rows are sorted by key."""
    size_m = graph.map.voxel_size_m

    def side(rows: Rows) -> npt.NDArray[np.bool_] | None:
        return chart_side(graph.normal[rows], graph.position[rows], limit, size_m)

    def components(half: Rows) -> list[Rows]:
        return [chart for chart in connected_parts(graph, half) if len(chart) >= least]

    return height_fields([members], side, components)


def chart_side(
    normals: Array, points: Array, limit: float, size_m: float
) -> npt.NDArray[np.bool_] | None:
    """
    Return how to bisect a chart, (n,) bool, or None if it has one height over one plane.

    Parameters
    ----------
    normals : (n, 3) float64
        Unit normals of its voxels.
    points : (n, 3) float64, m
        Their surfels.
    limit : float
        Least cosine to the mean normal for nearly all normals.
    size_m : float
        Edge of the voxels, m.

    """
    total = normals.sum(axis=0)
    mean = total / max(float(np.linalg.norm(total)), 1e-300)
    side = bisected_normals(normals) if is_folded(normals, mean, limit) else None
    if side is not None:
        axis = np.linalg.eigh(normals.T @ normals)[1][:, 2]
        facing = normals * np.where(normals @ axis < 0.0, -1.0, 1.0)[:, None]
        if is_folded(facing, axis, limit):
            return side
        mean = axis  # equal up to sign: the voxels have no common viewpoint
    return stacked_side(points, mean, size_m)


def stacked_side(points: Array, normal: Array, size_m: float) -> npt.NDArray[np.bool_] | None:
    """Return the upper half (n,) of a surface that overlaps itself; None for others."""
    heights, high_m = points @ normal, STACKED_VOXELS * size_m
    low, high = heights.min(), heights.max()
    if high - low <= high_m:
        return None
    least = int(np.abs(normal).argmin())
    x = np.cross(normal, np.eye(3)[least])
    x /= np.linalg.norm(x)
    # voxel indices have 21 bits, so column numbers are unique
    row, across = points @ x / size_m, points @ np.cross(normal, x) / size_m
    column = np.floor(row) * 2.0**26 + np.floor(across)
    order = np.argsort(column, kind='stable')
    first = np.flatnonzero(np.diff(column[order], prepend=np.nan) != 0.0)
    ordered = heights[order]
    extent = np.maximum.reduceat(ordered, first) - np.minimum.reduceat(ordered, first)
    if (extent > high_m).sum() <= STACKED_SHARE * len(first):
        return None
    return np.asarray(heights > 0.5 * (low + high), np.bool_)


def connected_parts(graph: SurfelGraph, rows: Rows) -> list[Rows]:
    """Return the connected components of rows, each in the order of the rows."""
    component = graph.connected(rows)
    if not component.any():  # the usual case: one component
        return [rows]
    order = np.argsort(component, kind='stable')
    return np.split(rows[order], np.flatnonzero(np.diff(component[order])) + 1)
