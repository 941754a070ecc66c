# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Gestalt: few keypoints, each with a descriptor of the relief around it.

Around a keypoint 4 rings are divided into 8 sectors, starting at the horizontal direction of the
normal of the neighbourhood; every bin holds the mean and the variance of the heights above the
keypoint. So places seen from different sides can be compared. Keypoints whose neighbourhood is
nearly a plane, or whose normal is nearly vertical, have no such direction and are dropped.

libpointmatcher takes neighbours from a cube, chooses the sign of the normal at random and writes
the coordinates of arbitrary points to warpedXYZ. Here the neighbours are the points within the
radius, the normal points towards the sensor, and warpedXYZ is the mean of the neighbours.

Source: Bosse and Zlot 2013, Place recognition using keypoint voting in large 3D lidar datasets.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters.base import generator, parameter, select, with_columns
from surfel_mapper.filters.columns import NORMALS
from surfel_mapper.filters.descriptors import times_of
from surfel_mapper.filters.grids import least_of_each, ScanVoxels
from surfel_mapper.filters.neighbours import coordinates, Ids, Points
from surfel_mapper.filters.registry import register
from surfel_mapper.filters.shapes import as_matrices, eigen, EIGEN_OF, Moments, ShapeFilter, shares
from surfel_mapper.scan import Scan

RINGS, SECTORS = 4, 8
BINS = RINGS * SECTORS

MAX_PLANARITY = 0.9
MIN_TILT = math.sin(math.radians(10.0))
"""Least sine of the angle between normal and vertical."""

SIZES = {
    'means': 3,
    'covariance': 9,
    'gestaltMeans': BINS,
    'gestaltVariances': BINS,
    'warpedXYZ': 3,
    'gestaltShapes': 2,
}
"""Components of the columns that only this filter makes."""


@register(libpointmatcher='GestaltDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class Gestalt(ShapeFilter):
    """Keep some keypoints and add gestaltMeans and gestaltVariances of the relief around them."""

    ratio: float = parameter(
        0.1,
        'Share of the occupied voxels from which a candidate is drawn.',
        low=1e-7,
        high=0.9999999,
        libpointmatcher='ratio',
    )
    radius_m: float = parameter(
        5.0,
        'Radius of the descriptor, m.',
        low=0.1,
        high=2.0**31 - 1,
        libpointmatcher='radius',
    )
    num_neighbours: int = parameter(
        7,
        'Keypoints with fewer neighbours are dropped.',
        low=3,
        high=2**31 - 1,
        libpointmatcher='knn',
    )
    size_x_m: float = parameter(
        1.0,
        'Edge along x of the voxels that give one candidate each, m.',
        low=0.001,
        libpointmatcher='vSizeX',
    )
    size_y_m: float = parameter(1.0, 'Edge along y, m.', low=0.001, libpointmatcher='vSizeY')
    size_z_m: float = parameter(1.0, 'Edge along z, m.', low=0.001, libpointmatcher='vSizeZ')
    eigen_of: str = parameter(
        'covariance',
        'Matrix of the eigenvalues and of covariance: covariance, scatter / (n - 1); mean_square, '
        'scatter / n; scatter, the sum over the n neighbours.',
        choices=tuple(EIGEN_OF),
        libpointmatcher_default='scatter',
    )
    keep_means: bool = parameter(
        False, 'Add means: mean of the neighbours, m.', libpointmatcher='keepMeans'
    )
    max_box_m: float = parameter(
        math.inf,
        'Keypoints whose neighbours extend farther along an axis are dropped, m.',
        libpointmatcher='maxBoxDim',
    )
    average_columns: bool = parameter(
        True,
        'No effect here: keypoints keep their columns.',
        libpointmatcher='averageExistingDescriptors',
    )
    max_time_window: float = parameter(
        math.inf,
        'Keypoints whose neighbours are farther apart in time are dropped; in the unit of the '
        'column of times.',
        libpointmatcher='maxTimeWindow',
    )
    keep_covariances: bool = parameter(
        False,
        'Add covariance of the neighbours, 9 numbers, m^2.',
        libpointmatcher='keepCovariances',
    )
    keep_features: bool = parameter(
        True,
        'Add gestaltMeans, m, gestaltVariances, m^2, of 4 rings of 8 sectors, warpedXYZ, the mean '
        'in the frame of the keypoint, m, and gestaltShapes: planarity, cylindricality.',
        libpointmatcher='keepGestaltFeatures',
    )
    seed: int = parameter(0, 'Seed of the random numbers.', low=0, high=2**31 - 1)

    def apply_finite(self, scan: Scan) -> Scan:
        """Return the keypoints, in the order of the points; nan is refused."""
        points = coordinates(scan)
        times = times_of(scan) if self.max_time_window < math.inf else None
        kept, shapes = [], []
        from scipy.spatial import cKDTree  # 0.3 s, only for chains with this filter

        tree = cKDTree(points)
        for row in self.candidates(scan, points):
            near = np.array(tree.query_ball_point(points[row], self.radius_m), np.int64)
            near = near[near != row]
            if len(near) < self.num_neighbours:
                continue
            if times is not None and np.ptp(times[near]) > self.max_time_window:
                continue
            if np.ptp(points[near], axis=0).max() > self.max_box_m:
                continue
            description = describe(points[row], points[near], self.radius_m)
            if description is not None:
                kept.append(row)
                shapes.append(description)
        rows = np.array(kept, np.int64)
        columns = {
            name: column.astype(scan.points.dtype) for name, column in self.columns(shapes).items()
        }
        return with_columns(select(scan, rows), **columns)

    def candidates(self, scan: Scan, points: Points) -> Ids:
        """Return the candidates: a random point from each of a share of the voxels."""
        if not len(points):
            return np.empty(0, np.int64)
        size = np.array([self.size_x_m, self.size_y_m, self.size_z_m])
        _, _, groups = ScanVoxels.over(points, size, 'minimum').group(points, True)
        random, number = generator(scan, self.seed), len(groups.first)
        rows = least_of_each(random.random(len(points)), groups.rows.astype(np.int64), number)
        return np.sort(rows[random.random(number) < self.ratio])

    def columns(self, shapes: list[dict[str, Any]]) -> dict[str, npt.NDArray[Any]]:
        """Return the columns asked for."""
        values = np.array([shape['values'] for shape in shapes]).reshape(-1, 3)
        vectors = np.array([shape['vectors'] for shape in shapes]).reshape(-1, 3, 3)
        count = np.array([shape['count'] for shape in shapes], np.int64)
        columns = self.shape_columns(values, vectors, count)
        if self.keep_normals:
            columns[NORMALS] = np.array([shape['normal'] for shape in shapes]).reshape(-1, 3)
        names = [name for name in SIZES if 'gestalt' in name or name == 'warpedXYZ']
        names = names if self.keep_features else []
        names += ['means'] if self.keep_means else []
        names += ['covariance'] if self.keep_covariances else []
        for name in names:
            columns[name] = np.array([shape[name] for shape in shapes]).reshape(-1, SIZES[name])
        if self.keep_covariances:
            columns['covariance'] = columns['covariance'] * EIGEN_OF[self.eigen_of](count)[:, None]
        return columns


def describe(keypoint: Points, around: Points, radius_m: float) -> dict[str, Any] | None:
    """Return the descriptor of a keypoint by the points around it; None: it has no direction."""
    moments = Moments.of_groups(around, np.zeros(len(around), np.int64), 1)
    values, vectors = eigen(moments.covariance)
    planarity, cylindricality, _ = shares(values)[0]
    normal = vectors[0, 0] * (-1.0 if vectors[0, 0] @ keypoint > 0.0 else 1.0)
    level = math.hypot(normal[0], normal[1])
    if not (planarity <= MAX_PLANARITY and level >= MIN_TILT):  # false if the normal is nan
        return None
    x, y = normal[0] / level, normal[1] / level
    R_keypoint_scan = np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])
    means, variances = relief((around - keypoint) @ R_keypoint_scan.T, radius_m)
    return {
        'count': len(around),
        'values': values[0],
        'vectors': vectors[0],
        'normal': normal,
        'means': moments.mean[0],
        'covariance': as_matrices(moments.covariance)[0],
        'gestaltMeans': means,
        'gestaltVariances': variances,
        'warpedXYZ': R_keypoint_scan @ (moments.mean[0] - keypoint),
        'gestaltShapes': (planarity, cylindricality),
    }


def relief(points: Points, radius_m: float) -> tuple[Points, Points]:
    """
    Return mean and variance of the heights in each bin, (4, 8) each, rings from the centre out.

    An empty bin takes the values of the next bin inwards, an innermost one 0.
    """
    x, y, z = points.T
    ring = np.minimum((np.hypot(x, y) * (RINGS / radius_m)).astype(np.int64), RINGS - 1)
    turn = np.arctan2(y, x) / (2.0 * np.pi) % 1.0
    sector = np.minimum((turn * SECTORS).astype(np.int64), SECTORS - 1)
    bins = ring * SECTORS + sector
    count = np.bincount(bins, minlength=BINS)
    safe = np.maximum(count, 1)
    means = np.bincount(bins, z, BINS) / safe
    variances = np.bincount(bins, (z - means[bins]) ** 2, BINS) / safe
    for bin_ in range(SECTORS, BINS):
        if count[bin_] == 0:
            means[bin_] = means[bin_ - SECTORS]
            variances[bin_] = variances[bin_ - SECTORS]
    return means.reshape(RINGS, SECTORS), variances.reshape(RINGS, SECTORS)
