# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Poses as x y z roll pitch yaw: m and rad, T = translation Rz(yaw) Ry(pitch) Rx(roll).

Angles are not wrapped. A rotation has two triples of angles, and further ones that differ by full
turns. The triple nearest to the previous one is chosen, so that a small correction of a pose never
jumps by a turn.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

TURN = 2.0 * np.pi


def transforms(poses: Floats) -> Floats:
    """Return the transforms, (V, 4, 4), of poses, (V, 6)."""
    sines, cosines = np.sin(poses[:, 3:]), np.cos(poses[:, 3:])
    (sr, sp, sy), (cr, cp, cy) = sines.T, cosines.T
    result = np.zeros((len(poses), 4, 4))
    result[:, 0, 0], result[:, 0, 1], result[:, 0, 2] = (
        cy * cp,
        cy * sp * sr - sy * cr,
        cy * sp * cr + sy * sr,
    )
    result[:, 1, 0], result[:, 1, 1], result[:, 1, 2] = (
        sy * cp,
        sy * sp * sr + cy * cr,
        sy * sp * cr - cy * sr,
    )
    result[:, 2, 0], result[:, 2, 1], result[:, 2, 2] = -sp, cp * sr, cp * cr
    result[:, :3, 3] = poses[:, :3]
    result[:, 3, 3] = 1.0
    return result


def poses_of(matrices: Floats, near: Floats) -> Floats:
    """
    Return the poses of transforms, with the angles nearest to those of reference poses.

    Parameters
    ----------
    matrices : (V, 4, 4) float64
        Rigid transforms.
    near : (V, 6) float64
        Reference poses, which select one of the equivalent triples of angles.

    Returns
    -------
    (V, 6) float64
        At a pitch of a quarter turn roll and yaw are the same motion, and the yaw is arbitrary;
        the roll is consistent with it.

    """
    R = matrices[:, :3, :3]
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    pitch = np.arctan2(-R[:, 2, 0], np.hypot(R[:, 0, 0], R[:, 1, 0]))
    sy, cy = np.sin(yaw), np.cos(yaw)
    roll = np.arctan2(sy * R[:, 0, 2] - cy * R[:, 1, 2], cy * R[:, 1, 1] - sy * R[:, 0, 1])
    first = np.stack([roll, pitch, yaw], axis=1)
    second = np.stack([roll + np.pi, np.pi - pitch, yaw + np.pi], axis=1)
    candidates = np.stack([first, second])
    candidates += TURN * np.round((near[:, 3:] - candidates) / TURN)
    distance = ((candidates - near[:, 3:]) ** 2).sum(axis=2)
    nearer = np.where((distance[1] < distance[0])[:, None], candidates[1], candidates[0])
    return np.concatenate([matrices[:, :3, 3], nearer], axis=1)


def skew(vectors: Floats) -> Floats:
    """Return the matrices (V, 3, 3) of the cross product with vectors (V, 3) on the left."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def pcl_incidence(poses: Floats) -> Floats:
    """
    Return PCL's Jacobian of poses, from dp to a motion about the origin of the map.

    It belongs to the order Rx(roll) Ry(pitch) Rz(yaw), which is not the order of ``transforms``.

    Parameters
    ----------
    poses : (V, 6) float64
        x y z roll pitch yaw.

    Returns
    -------
    (V, 6, 6) float64
        Rows: translation, then rotation about x, y, z. Singular at a pitch of a quarter turn.

    """
    x, y, z = poses[:, 0], poses[:, 1], poses[:, 2]
    sr, cr = np.sin(poses[:, 3]), np.cos(poses[:, 3])
    sp, cp = np.sin(poses[:, 4]), np.cos(poses[:, 4])
    H = np.zeros((len(poses), 6, 6))
    H[:, 0, 0] = H[:, 1, 1] = H[:, 2, 2] = H[:, 3, 3] = 1.0
    H[:, 0, 4], H[:, 0, 5] = y * sr - z * cr, y * cr * cp + z * sr * cp
    H[:, 1, 3], H[:, 1, 4], H[:, 1, 5] = z, -x * sr, -x * cr * cp + z * sp
    H[:, 2, 3], H[:, 2, 4], H[:, 2, 5] = -y, x * cr, -x * sr * cp - y * sp
    H[:, 3, 5] = sp
    H[:, 4, 4], H[:, 4, 5] = cr, -sr * cp
    H[:, 5, 4], H[:, 5, 5] = sr, cr * cp
    return H
