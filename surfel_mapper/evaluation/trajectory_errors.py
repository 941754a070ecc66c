# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Errors of estimated poses: absolute, relative, and as drift over distance.

The absolute error measures the global consistency of a trajectory, after the best rigid motion
onto the true one; the relative error measures each step separately. Both equal evo's ape and rpe.

Sources: Umeyama 1991 for the motion; Sturm et al. 2012 (A benchmark for the evaluation of RGB-D
SLAM systems) for the errors; Geiger et al. 2012 (KITTI) for drift over distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from surfel_mapper.geometry import Transform

Floats = npt.NDArray[np.float64]

DRIFT_SHARES = (0.125, 0.25, 0.5)
"""Lengths of the segments over which drift is measured, as shares of the path."""

STRAIGHT = 1e-3
"""Width of a straight drive as a share of its length, whatever its errors."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """
    Errors of poses.

    Attributes
    ----------
    translation_m : (P,) float64
    rotation_deg : (P,) float64
        In [0, 180].

    """

    translation_m: Floats
    rotation_deg: Floats

    def summary(self) -> dict[str, dict[str, float]]:
        """Return rmse, mean, median and max of both, for reports."""
        by_name = {'translation_m': self.translation_m, 'rotation_deg': self.rotation_deg}
        return {
            name: {
                'rmse': float(np.sqrt(np.mean(np.square(errors)))),
                'mean': float(np.mean(errors)),
                'median': float(np.median(errors)),
                'max': float(np.max(errors)),
            }
            for name, errors in by_name.items()
        }


def compare(
    stamp_ns: npt.NDArray[np.int64],
    T_map_estimated: npt.ArrayLike,
    true_ns: npt.NDArray[np.int64],
    T_map_true: npt.ArrayLike,
    *,
    max_difference_ns: int = 0,
) -> dict[str, Any]:
    """
    Return all errors of a trajectory as plain numbers, for files and reports.

    Parameters
    ----------
    stamp_ns, true_ns : (S,) and (R,) int64
        Times of the poses, ascending.
    T_map_estimated, T_map_true : (S, 4, 4) and (R, 4, 4) float64
        Poses of the same frame, each in its own map frame.
    max_difference_ns : int
        Maximum time difference between compared poses.

    Returns
    -------
    dict
        num_poses; on_a_line, whether positions are as near to a line as their errors and so do not
        determine the motion; absolute (after the best rigid motion) and relative (from pose to
        pose), each with rmse, mean, median and max of translation_m and rotation_deg;
        drift_m_per_100m and drift_deg_per_100m.

    Raises
    ------
    ValueError
        If fewer than two poses have a counterpart.

    """
    rows, true_rows = common_stamps(stamp_ns, true_ns, max_difference_ns)
    if len(rows) < 2:
        raise ValueError(
            f'{len(rows)} poses within {max_difference_ns / 1e9:g} s of one another, '
            f'of {len(stamp_ns)} and {len(true_ns)}; expected at least 2'
        )
    estimated, true = np.asarray(T_map_estimated)[rows], np.asarray(T_map_true)[true_rows]
    drift_m, drift_deg = drift(estimated, true)
    absolute = absolute_errors(estimated, true)
    error_m = float(np.sqrt(np.mean(absolute.translation_m**2)))
    along_m, across_m = min(map(widths_m, (estimated, true)), key=lambda width: width[1])
    return {
        'num_poses': len(rows),
        'on_a_line': across_m <= max(error_m, STRAIGHT * along_m),
        'absolute': absolute.summary(),
        'relative': relative_errors(estimated, true).summary(),
        'drift_m_per_100m': drift_m,
        'drift_deg_per_100m': drift_deg,
    }


def widths_m(T_map_pose: Floats) -> tuple[float, float]:
    """Return the root mean square distances of positions along their longest axis, and across."""
    position = T_map_pose[:, :3, 3]
    values = np.linalg.svd(position - position.mean(axis=0), compute_uv=False)
    along, across = (*values, 0.0, 0.0)[:2]
    return float(along) / len(position) ** 0.5, float(across) / len(position) ** 0.5


def absolute_errors(estimated: Floats, true: Floats) -> PoseErrors:
    """Return the error of every pose (S, 4, 4) after the best rigid motion of all."""
    aligned = best_motion(estimated[:, :3, 3], true[:, :3, 3]) @ estimated
    return _errors(np.linalg.inv(true) @ aligned)


def relative_errors(estimated: Floats, true: Floats, *, step: int = 1) -> PoseErrors:
    """Return the error of the motion between every pose (S, 4, 4) and the pose ``step`` later."""
    rows = np.arange(len(true) - step)
    return _motion_errors(estimated, true, rows, rows + step)


def drift(estimated: Floats, true: Floats) -> tuple[float, float]:
    """
    Return the drift over segments from an eighth to half of the path.

    Parameters
    ----------
    estimated, true : (S, 4, 4) float64
        Poses of one frame at the same times.

    Returns
    -------
    translation_m, rotation_deg : float
        Root mean square over all segments, per 100 m; nan if the path has no length.

    """
    steps_m = np.sqrt((np.diff(true[:, :3, 3], axis=0) ** 2).sum(axis=1))
    path_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    if not path_m[-1] > 0.0:
        return float('nan'), float('nan')
    squares = []
    for share in DRIFT_SHARES:
        last = np.searchsorted(path_m, path_m + share * path_m[-1])
        first = np.flatnonzero(last < len(path_m))
        last = last[first]
        errors = _motion_errors(estimated, true, first, last)
        per_100_m = 100.0 / (path_m[last] - path_m[first])
        squares.append(np.square([errors.translation_m, errors.rotation_deg] * per_100_m))
    translation_m, rotation_deg = np.sqrt(np.concatenate(squares, axis=1).mean(axis=1))
    return float(translation_m), float(rotation_deg)


def best_motion(estimated: Floats, true: Floats) -> Transform:
    """
    Return the rigid transform from positions (S, 3) to true positions in the least squares sense.

    For positions on a line or in a point it is one of several.
    """
    centre, target = estimated.mean(axis=0), true.mean(axis=0)
    u, _, vt = np.linalg.svd((true - target).T @ (estimated - centre))
    mirrored = np.linalg.det(u) * np.linalg.det(vt) < 0.0
    rotation = u @ np.diag([1.0, 1.0, -1.0 if mirrored else 1.0]) @ vt
    T_true_estimated = np.eye(4)
    T_true_estimated[:3, :3] = rotation
    T_true_estimated[:3, 3] = target - rotation @ centre
    return T_true_estimated


def common_stamps(
    stamp_ns: npt.NDArray[np.int64], other_ns: npt.NDArray[np.int64], max_difference_ns: int = 0
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """
    Return the matching rows of two ascending lists of stamps.

    A stamp of the first list matches the nearest of the second if their difference is at most
    ``max_difference_ns`` and no other stamp of the first list is nearer to it.
    """
    if not len(other_ns) or not len(stamp_ns):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    upper = np.clip(np.searchsorted(other_ns, stamp_ns), 1, max(len(other_ns) - 1, 1))
    upper = np.minimum(upper, len(other_ns) - 1)
    lower = np.maximum(upper - 1, 0)
    is_lower = np.abs(other_ns[lower] - stamp_ns) <= np.abs(other_ns[upper] - stamp_ns)
    nearest = np.where(is_lower, lower, upper)
    apart_ns = np.abs(other_ns[nearest] - stamp_ns)
    order = np.lexsort((apart_ns, nearest))
    is_first = np.diff(nearest[order], prepend=-1) > 0
    rows = np.sort(order[is_first & (apart_ns[order] <= max_difference_ns)])
    return rows.astype(np.int64), nearest[rows].astype(np.int64)


def _motion_errors(
    estimated: Floats, true: Floats, first: npt.NDArray[np.int64], last: npt.NDArray[np.int64]
) -> PoseErrors:
    """Return the errors of the motions between rows."""
    measured = np.linalg.inv(estimated[first]) @ estimated[last]
    expected = np.linalg.inv(true[first]) @ true[last]
    return _errors(np.linalg.inv(expected) @ measured)


def _errors(off: Floats) -> PoseErrors:
    """Return the magnitude of transforms (P, 4, 4)."""
    turned_rad = Rotation.from_matrix(off[:, :3, :3]).magnitude()
    return PoseErrors(np.linalg.norm(off[:, :3, 3], axis=1), np.degrees(turned_rad))
