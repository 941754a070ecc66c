# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Search of a whole map for the poses of a scan, whatever its place and heading.

Walls, trunks and vehicles are seen from everywhere, ground and roofs are not: an image of the map
from above holds the number of occupied voxels of each column. The image of the scan, turned in
steps of HEADING_DEG, is correlated with it by the Fourier transform, which compares all positions
at once. The height follows from the lowest voxels of common columns. In a hall, of which the map
has the first half of a walk, 13 of 20 single scans rank their place first and all among the first
40, in half a second. The features of map-closures match none of them.

The z axes of scan and map have to be about vertical.

Source: Barnea and Silverman 1972 for search by correlation; Olson 2009 for scans.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import scipy  # loads scipy.fft at its first use: 0.2 s with Python 3.10

from surfel_mapper.geometry import pose_matrix, Transform

Floats = npt.NDArray[np.float64]

HEADING_DEG = 4.0
"""Step of the headings, deg: registration corrects twice as much."""

REACH = 120
"""Points of the scan farther away are left out, in pixels: 60 m with voxels of 0.5 m."""

TALL = 7
"""Occupied voxels of a column that count fully; higher ones do not say more."""

MAX_PIXELS = 1 << 22
"""Limit of the image of a map, pixels, which are larger if needed: 1 km by 1 km at 0.5 m."""

MAX_PLACES = 40
"""Number of best places that are returned."""

PEAKS = 20
"""Number of best positions of a heading."""

APART = 3.0
"""Positions nearer to each other are one place, in pixels, if the headings are alike too."""


class PlaceSearch:
    """
    Image of a map from above, in which scans are searched for.

    Parameters
    ----------
    points : (N, 3) float64, m
        One point of each voxel of the map, at least one.
    voxel_size_m : float
        Edge of a voxel.

    """

    def __init__(self, points: Floats, voxel_size_m: float) -> None:
        self._low = points[:, :2].min(axis=0)
        extent_m = points[:, :2].max(axis=0) - self._low
        needed_m = math.sqrt(float(extent_m.prod()) / MAX_PIXELS)
        self._pixel_m = max(voxel_size_m, needed_m)
        self._shape = (extent_m / self._pixel_m).astype(np.int64) + 1
        self._lowest_m = np.full(self._shape, np.inf)
        rows = self._pixels(points[:, :2], self._low)
        np.minimum.at(self._lowest_m, (rows[:, 0], rows[:, 1]), points[:, 2])
        self._padded = [
            scipy.fft.next_fast_len(int(size) + 2 * REACH + 1, real=True) for size in self._shape
        ]
        self._spectrum = scipy.fft.rfft2(heights(rows, self._shape), self._padded)

    def poses(self, points: Floats) -> list[Transform]:
        """
        Return the poses at which a scan resembles the map, the best first.

        Parameters
        ----------
        points : (N, 3) float64, m
            One point of each voxel of the scan, in its frame.

        """
        near = points[np.hypot(points[:, 0], points[:, 1]) < (REACH - 1) * self._pixel_m]
        peaks = [self._peaks(near, angle) for angle in np.arange(0.0, 360.0, HEADING_DEG).tolist()]
        table = np.concatenate(peaks)
        poses: list[Transform] = []
        chosen: Floats = np.empty((0, 3))
        for _, x_m, y_m, angle in table[np.argsort(-table[:, 0])].tolist():
            turn = np.abs((chosen[:, 2] - angle + 180.0) % 360.0 - 180.0)
            way_m = np.hypot(chosen[:, 0] - x_m, chosen[:, 1] - y_m)
            if ((way_m < APART * self._pixel_m) & (turn <= 2.0 * HEADING_DEG)).any():
                continue
            chosen = np.append(chosen, [[x_m, y_m, angle]], axis=0)
            poses.append(self._pose(near, x_m, y_m, angle))
            if len(poses) == MAX_PLACES:
                break
        return poses

    def _peaks(self, points: Floats, angle_deg: float) -> Floats:
        """Return likeness, x, y and heading of the best positions (K, 4) at a heading."""
        at = self._pixels(turned_xy(points, angle_deg), np.full(2, -REACH * self._pixel_m))
        image = heights(at, np.full(2, 2 * REACH + 1))
        product = self._spectrum * np.conj(scipy.fft.rfft2(image, self._padded))
        likeness = scipy.fft.irfft2(product, self._padded) / max(float(image.sum()), 1.0)
        best = np.argpartition(likeness.ravel(), -PEAKS)[-PEAKS:]
        shift = np.column_stack(np.unravel_index(best, likeness.shape))
        shift = np.where(shift >= self._shape, shift - self._padded, shift)
        xy_m = self._low + (shift + REACH) * self._pixel_m
        return np.column_stack([likeness.ravel()[best], xy_m, np.full(len(best), angle_deg)])

    def _pose(self, points: Floats, x_m: float, y_m: float, angle_deg: float) -> Transform:
        """Return the pose of a scan at a position and a heading, at the height of the map."""
        rows = self._pixels(turned_xy(points, angle_deg) + np.array([x_m, y_m]), self._low)
        inside = ((rows >= 0) & (rows < self._shape)).all(axis=1)
        index = rows[inside] @ np.array([self._shape[1], 1])
        order = np.lexsort((points[inside, 2], index))
        index, first = np.unique(index[order], return_index=True)
        off_m = self._lowest_m.ravel()[index] - points[inside, 2][order][first]
        off_m = off_m[np.isfinite(off_m)]
        z_m = float(np.median(off_m)) if len(off_m) else 0.0
        half = 0.5 * math.radians(angle_deg)
        return pose_matrix((x_m, y_m, z_m), (0.0, 0.0, math.sin(half), math.cos(half)))

    def _pixels(self, xy: Floats, low: Floats) -> npt.NDArray[np.int64]:
        """Return the pixels of positions (N, 2), m."""
        return np.floor((xy - low) / self._pixel_m).astype(np.int64)


def heights(
    pixels: npt.NDArray[np.int64], shape: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    """Return the image of the number of voxels above the lowest by pixel, up to 1."""
    index = pixels @ np.array([shape[1], 1])
    count = np.bincount(index, minlength=int(shape.prod())).reshape(shape)
    image = np.clip(count - 1, 0, TALL - 1) / (TALL - 1)
    return image.astype(np.float32)  # transformed in half the time


def turned_xy(points: Floats, angle_deg: float) -> Floats:
    """Return the horizontal coordinates (N, 2) of points turned about the vertical."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.asarray(points[:, :2] @ np.array([[c, s], [-s, c]]))
