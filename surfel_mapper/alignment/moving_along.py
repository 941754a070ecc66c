# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The cells of a scan that move along with the sensor, as vehicles in the next lanes do.

What stands still is displaced between two scans by the motion of the sensor. A cell that was at
the same place in the scan before, although its surface should have moved on across itself, moves
along, and so do the edges of what it belongs to. Ground and walls along the way look the same from
scan to scan too, but their normals are across the motion: they say nothing against it.

This needs a motion that is known before, from the scans before, and that cannot have ended since
by braking; if a collision ended it, the registration finds that the scan fits better at rest.
Vehicles that move along from the first scan on are not distinguished from the world; see
pipeline/surroundings.py.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

STRIDES = np.array([1, 1 << 20, 1 << 40])
"""Numbers of the cells along the axes, up to 2^19 cells from the body, in one integer."""

SAME_PLACE = 0.3
"""Displacement along the motion, in cells, below which a cell is at the same place."""

ACROSS = 0.2
"""Smallest cosine between normal and motion of a surface that the motion moves across itself."""

MUCH = 0.04
"""Share of the cells that move along from which on it matters; 1 to 3 % of the cells of a street
seem to, 16 % among nine trucks."""

EDGE = 2.0
"""Distance in cells from a cell that moves along within which its neighbours do too."""


def moving_along(
    cells: npt.NDArray[np.float64],
    before: npt.NDArray[np.float64],
    motion_m: npt.NDArray[np.float64],
    normals: npt.NDArray[np.float64],
    cell_m: float,
) -> npt.NDArray[np.bool_]:
    """
    Return which cells of a scan move along with the body that carries the sensor.

    Parameters
    ----------
    cells : (K, 3) float64, m
        Cells of the scan in the frame of the body.
    before : (B, 3) float64, m
        Cells of the scan before, in the frame of the body at its time.
    motion_m : (3,) float64, m
        The motion of the body between the two, at least a cell.
    normals : (K, 3) float64
        Unit normals, in the frame of the body, of the surfels that the cells should hit; NaN
        where there is none that is usable, as where a vehicle is new.
    cell_m : float
        Edge of a cell.

    Returns
    -------
    (K,) bool
        All False if it is not much.

    """
    nothing = np.zeros(len(cells), np.bool_)
    if not (len(before) and len(cells)):
        return nothing
    direction = motion_m / np.linalg.norm(motion_m)
    may_move = ~(np.abs(normals @ direction) < ACROSS)  # without a surfel too
    found: npt.NDArray[np.bool_] = may_move & at_same_place(cells, before, direction, cell_m)
    if found.mean() < MUCH:
        return nothing
    others = np.flatnonzero(may_move & ~found)
    if len(others):
        from scipy.spatial import cKDTree  # which maps without such company do not need

        away_m, _ = cKDTree(cells[found]).query(cells[others], distance_upper_bound=EDGE * cell_m)
        found[others[np.isfinite(away_m)]] = True
    return found


def staying(
    cells: npt.NDArray[np.float64],
    before: npt.NDArray[np.float64],
    motion_m: npt.NDArray[np.float64],
    normals: npt.NDArray[np.float64],
    cell_m: float,
) -> float:
    """
    Return the share of cells, of those on surfaces across the motion, that kept their place.

    The arguments are those of ``moving_along``. In [0, 1]; 0 without such cells.
    """
    direction = motion_m / np.linalg.norm(motion_m)
    tells = np.abs(normals @ direction) >= ACROSS
    if not (tells.any() and len(before)):
        return 0.0
    return float(at_same_place(cells[tells], before, direction, cell_m).mean())


def at_same_place(
    cells: npt.NDArray[np.float64],
    before: npt.NDArray[np.float64],
    direction: npt.NDArray[np.float64],
    cell_m: float,
) -> npt.NDArray[np.bool_]:
    """Return which cells (K, 3) equal one of (B, 3) before, along a unit vector, (K,) bool."""
    keys, known = (np.floor(each / cell_m).astype(np.int64) @ STRIDES for each in (cells, before))
    order = np.argsort(known)
    rows = order[np.searchsorted(known, keys, sorter=order).clip(max=len(known) - 1)]
    off_m = np.abs((cells - before[rows]) @ direction)
    same: npt.NDArray[np.bool_] = (known[rows] == keys) & (off_m < SAME_PLACE * cell_m)
    return same
