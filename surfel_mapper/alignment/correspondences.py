# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Correspondences between the points of two scans, and the pairs of scans to compare.

A scan is represented by samples: its points, or the centroids of its surfels with normals and
variances. Nearest neighbours come from scipy's k-d tree, built once for each scan in the frame of
the scan, so that it stays valid when the pose changes. Points are weighted equally in all
directions, surfels only across the surface: the centroids of one wall seen from two places differ
along it, as the rings of a lidar on the road move with the lidar, and would hold the scans back.
Away from its centroid the uncertainty of a surfel grows, the more the narrower it is; weighting by
it halves the angular errors.

Source: Chen and Medioni 1992 for points and planes; Segal, Haehnel and Thrun 2009.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import AlignmentError
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.mapping.window import Travel

Floats = npt.NDArray[np.float64]
Pairs = npt.NDArray[np.int32]

LOOP_FACTOR = 3.0
"""Minimum length of a loop, as a multiple of the distance between its ends."""

LOOPS_A_SCAN = 3
"""Maximum number of loop candidates of a scan."""

ROUGHNESS_M = 0.005
"""Minimum standard deviation of a point from its surface, because no wall is an exact plane."""

MIN_PLANARITY = 0.2
"""Surfels of less planarity are ignored: their normal is unreliable, as in a voxel of one ring."""


class Samples:
    """
    Samples that represent a scan, in the frame of the scan.

    Parameters
    ----------
    position : (N, 3) float, m
        Positions, all finite.
    normal : (N, 3) float, optional
        Unit normals, required to compare angles.
    variance : (N,) float, optional
        Variance of the position across the surface, m^2; required for surface weights.
    tilt_variance : (N,) float, optional
        Variance of the normal, rad^2; required for surface weights.

    Raises
    ------
    AlignmentError
        If a number is not finite or shapes do not match.

    """

    def __init__(
        self,
        position: npt.ArrayLike,
        normal: npt.ArrayLike | None = None,
        variance: npt.ArrayLike | None = None,
        tilt_variance: npt.ArrayLike | None = None,
    ) -> None:
        self.position = np.ascontiguousarray(position, np.float64)
        if self.position.ndim != 2 or self.position.shape[1] != 3:
            raise AlignmentError(f'samples: shape {self.position.shape}, expected (N, 3)')
        num = len(self.position)
        self.normal = None if normal is None else np.asarray(normal, np.float64)
        self.variance = None if variance is None else np.asarray(variance, np.float64)
        self.tilt_variance = (
            None if tilt_variance is None else np.asarray(tilt_variance, np.float64)
        )
        for name, values, shape in (
            ('position', self.position, (num, 3)),
            ('normal', self.normal, (num, 3)),
            ('variance', self.variance, (num,)),
            ('tilt_variance', self.tilt_variance, (num,)),
        ):
            if values is not None and (values.shape != shape or not np.isfinite(values).all()):
                raise AlignmentError(f'samples: {name} is not {shape} and finite')
        from scipy.spatial import cKDTree  # 0.4 s, only alignment pays

        self.tree = cKDTree(self.position)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.position)

    @classmethod
    def of_surfels(cls, surfels: Surfels, min_points: int = 1) -> Samples:
        """Return the samples of sufficiently planar surfels."""
        flat = (surfels.planarity >= MIN_PLANARITY) & (surfels.num_points >= min_points)
        chosen = surfels.select(flat)
        e0, e1, _ = chosen.eigenvalues.T
        variance = (e0 + ROUGHNESS_M**2) / chosen.num_points
        return cls(chosen.position, chosen.normal, variance, variance / e1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """
    Limits of a correspondence.

    Attributes
    ----------
    max_distance_m : float
        Maximum distance.
    max_angle_deg : float
        Maximum angle between the normals; 180: normals are not compared.
    reciprocal : bool
        Whether each sample must be the nearest of the other.

    """

    max_distance_m: float
    max_angle_deg: float = 180.0
    reciprocal: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        if not 0.0 < self.max_distance_m < math.inf:
            raise AlignmentError(f'max_distance_m {self.max_distance_m}, expected over 0, finite')
        if not 0.0 < self.max_angle_deg <= 180.0:
            raise AlignmentError(f'max_angle_deg {self.max_angle_deg}, expected in (0, 180]')


def match(source: Samples, target: Samples, T_target_source: Floats, limits: Limits) -> Pairs:
    """
    Pair every sample of a scan with the nearest one of another, within limits.

    Parameters
    ----------
    source, target : Samples
        Samples of the two scans.
    T_target_source : (4, 4) float64
        Pose of the source in the frame of the target.
    limits : Limits
        Limits of a correspondence.

    Returns
    -------
    (K, 2) int32
        Rows of source and target, as LUM takes them.

    Raises
    ------
    AlignmentError
        If angles are compared and a scan has no normals.

    """
    positions = moved(source.position, T_target_source)
    distance, rows = target.tree.query(positions, distance_upper_bound=limits.max_distance_m)
    chosen = np.flatnonzero(np.isfinite(distance))
    rows = rows[chosen]
    if limits.max_angle_deg < 180.0:
        R = T_target_source[:3, :3]
        kept = _alike(source, target, R, (chosen, rows), limits.max_angle_deg)
        chosen, rows = chosen[kept], rows[kept]
    if limits.reciprocal and len(chosen):
        asked, of = np.unique(rows, return_inverse=True)
        back = (target.position[asked] - T_target_source[:3, 3]) @ T_target_source[:3, :3]
        kept = source.tree.query(back)[1][of] == chosen
        chosen, rows = chosen[kept], rows[kept]
    return np.stack([chosen, rows], axis=1).astype(np.int32)


def surface_weights(
    source: Samples, target: Samples, pairs: Pairs, T_target_source: Floats, scale_m: float
) -> Floats:
    """
    Return the weight matrices (K, 3, 3) of the gaps of pairs, in the frame of the target.

    Across the surface the weight is the inverse of the variance of both ends, that of the target
    taken at the position of the source. It decreases for gaps beyond the scale (Geman and
    McClure), so that wrong pairs have little effect.
    """
    if source.variance is None or target.variance is None or target.tilt_variance is None:
        raise AlignmentError('samples are not surfels: they have no variance')
    if target.normal is None:
        raise AlignmentError('samples are not surfels: they have no normals')
    i, j = pairs.T
    normal = target.normal[j]
    gap = moved(source.position[i], T_target_source) - target.position[j]
    across_sq = (gap * normal).sum(axis=1) ** 2
    along_sq = (gap * gap).sum(axis=1) - across_sq
    variance = source.variance[i] + target.variance[j] + target.tilt_variance[j] * along_sq
    weight = 1.0 / (variance * (1.0 + across_sq / scale_m**2) ** 2)
    return np.asarray(weight[:, None, None] * normal[:, :, None] * normal[:, None, :])


def path_lengths(T_map_sensor: Floats, frame_ids: Sequence[str] | None = None) -> Floats:
    """
    Return the path travelled until each scan, (S,) m.

    Parameters
    ----------
    T_map_sensor : (S, 4, 4) float64
        Poses, in the order of the path.
    frame_ids : sequence of str, optional
        Frames of the sensors of the scans, by default all the same; see Travel.

    """
    frames = [''] * len(T_map_sensor) if frame_ids is None else frame_ids
    travel = Travel()
    return np.array([travel.add(*scan) for scan in zip(frames, T_map_sensor, strict=True)])


def loop_candidates(
    T_map_sensor: Floats,
    max_distance_m: float,
    path_m: Floats | None = None,
    min_path_m: float = 0.0,
) -> list[tuple[int, int]]:
    """
    Return the pairs of scans that are close although the path between them is long.

    Parameters
    ----------
    T_map_sensor : (S, 4, 4) float64
        Poses, in the order of the path.
    max_distance_m : float
        Maximum distance of candidates; 0 disables loops.
    path_m : (S,) float64, m, optional
        Path travelled until each scan, by default the sum of the distances between the poses.
    min_path_m : float
        Minimum length of the path between candidates.

    Returns
    -------
    list of (int, int)
        The later scan first; for each the nearest ones. The path between them is at least
        ``min_path_m`` and three times ``max_distance_m`` long.

    """
    if max_distance_m <= 0.0:
        return []
    from scipy.spatial import cKDTree

    position = T_map_sensor[:, :3, 3]
    path_m = path_lengths(T_map_sensor) if path_m is None else path_m
    pairs = cKDTree(position).query_pairs(max_distance_m, output_type='ndarray')
    least_m = max(LOOP_FACTOR * max_distance_m, min_path_m)
    near = pairs[path_m[pairs[:, 1]] - path_m[pairs[:, 0]] >= least_m]
    distance = np.linalg.norm(position[near[:, 1]] - position[near[:, 0]], axis=1)
    num_of: dict[int, int] = {}
    loops = []
    for target, source in near[np.argsort(distance, kind='stable')].tolist():
        if num_of.get(source, 0) < LOOPS_A_SCAN:
            num_of[source] = num_of.get(source, 0) + 1
            loops.append((source, target))
    return sorted(loops)


def moved(points: npt.NDArray[Any], T: Floats) -> Floats:
    """Return points (N, 3) moved by a transform (4, 4)."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _alike(
    source: Samples,
    target: Samples,
    R_target_source: Floats,
    pairs: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]],
    max_angle_deg: float,
) -> npt.NDArray[np.bool_]:
    """Return which pairs have normals within an angle."""
    if source.normal is None or target.normal is None:
        raise AlignmentError('samples have no normals, which max_angle_deg below 180 requires')
    normal = source.normal[pairs[0]] @ R_target_source.T
    cosine = (normal * target.normal[pairs[1]]).sum(axis=1)
    return np.asarray(cosine >= math.cos(math.radians(max_angle_deg)))
