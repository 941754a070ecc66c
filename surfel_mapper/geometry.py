# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Rigid transforms as (4, 4) float64 matrices ``T_a_b``, quaternions xyzw, normals of triangles.

The pose of a scan determines how its points are quantised, and maps made on different machines are
compared bit for bit. So the functions that compute poses (pose_matrix, compose, inverse,
interpolate) use only + - * / and sqrt, which IEEE 754 rounds in one way, on Python floats in a
fixed order: no BLAS, no fused multiply-add, no sine whose last bit depends on the math library.
rotation_angle, se3_exp and se3_log need such functions and may differ in that bit.

Sources: Shepperd 1978 for the quaternion of a matrix; Eberly 2011 (A Fast and Accurate Algorithm
for Computing SLERP) for the series of slerp without trigonometry; Barfoot 2017 (State Estimation
for Robotics) for the exponential map.
"""

from __future__ import annotations

from collections.abc import Iterable
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array, is_unit

Transform = npt.NDArray[np.float64]
"""A (4, 4) float64 matrix; takes points in frame b to frame a if called T_a_b."""

MAX_SKEW = 1e-4
"""Tolerance of the orthonormality of a rotation; matrices of float32 are within 1e-6."""

MAX_TRANSLATION_M = 1e9
"""Limit of a translation: float64 resolves 0.1 um there, and geocentric ones are of 1e7 m."""

SMALL_ANGLE_SQ = 1e-8
"""Squared angle, rad^2, below which two terms of a series are exact to float64."""


def pose_matrix(xyz: Iterable[float], q_xyzw: Iterable[float]) -> Transform:
    """
    Return the transform of a translation and a quaternion, the quaternion normalised.

    Parameters
    ----------
    xyz : 3 floats, m
        Origin of frame b in frame a.
    q_xyzw : 4 floats
        Rotation of frame b in frame a.

    Returns
    -------
    (4, 4) float64
        T_a_b. q and -q give the same bits.

    Raises
    ------
    ValueError
        If a number is missing or not finite, or the square of the norm of the quaternion is not
        1 +- 1e-2.

    """
    try:
        t, q = [*map(float, xyz)], [*map(float, q_xyzw)]
    except TypeError:
        raise ValueError(
            f'pose of a {type(xyz).__name__} and a {type(q_xyzw).__name__}, expected 3 numbers '
            '(x y z) and 4 (qx qy qz qw)'
        ) from None
    if len(t) != 3 or len(q) != 4:
        raise ValueError(
            f'pose of {len(t)} and {len(q)} numbers, expected 3 (x y z) and 4 (qx qy qz qw)'
        )
    if not all(map(math.isfinite, t + q)):
        raise ValueError(f'pose {t} {q}: expected finite numbers')
    norm = math.sqrt(((q[0] * q[0] + q[1] * q[1]) + q[2] * q[2]) + q[3] * q[3])
    if not is_unit(q):
        raise ValueError(f'quaternion {q} has norm {norm:.6g}, expected 1 (order x y z w)')
    x, y, z, w = (v / norm for v in q)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w), t[0]],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w), t[1]],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y), t[2]],
        [0.0, 0.0, 0.0, 1.0],
    ]
    return np.array(rows)


def q_xyzw(T_a_b: Transform) -> npt.NDArray[np.float64]:
    """
    Return the rotation of a transform as a unit quaternion (4,), order x y z w, w >= 0.

    The largest of the four components is computed first and divides the others, so none loses
    digits at any angle. At half a turn (w = 0) the sign is that of this division.
    """
    return np.array(_quaternion(T_a_b))


def quaternions(T_a_b: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """
    Return the rotations of transforms (S, 4, 4), or (S, 3, 3), as quaternions (S, 4).

    They are those of q_xyzw, bit for bit.
    """
    rows = np.ascontiguousarray(T_a_b[:, :3, :3].transpose(1, 2, 0))
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rows
    candidates = np.array(_candidates(r00, r01, r02, r10, r11, r12, r20, r21, r22))
    is_taken = (r00 + r11 + r22 > 0.0, (r00 >= r11) & (r00 >= r22), r11 >= r22)
    first = np.argmax([*is_taken, np.ones(len(r00), bool)], axis=0)
    q = candidates[first, :, np.arange(len(r00))]
    x, y, z, w = q.T
    norm = np.sqrt(((x * x + y * y) + z * z) + w * w)
    return np.asarray(q / np.where(w < 0.0, -norm, norm)[:, None])


def compose(T_a_b: Transform, T_b_c: Transform) -> Transform:
    """Return T_a_c, the product of two transforms, summed from left to right."""
    (a, b) = T_a_b.tolist(), T_b_c.tolist()
    rows = []
    for x, y, z, t in a[:3]:
        row = []
        for k in range(4):
            row.append((x * b[0][k] + y * b[1][k]) + z * b[2][k])
        row[3] += t
        rows.append(row)
    rows.append([0.0, 0.0, 0.0, 1.0])
    return np.array(rows)


def inverse(T_a_b: Transform) -> Transform:
    """Return T_b_a, the inverse of a rigid transform: its rotation transposed."""
    m = T_a_b.tolist()
    x, y, z = m[0][3], m[1][3], m[2][3]
    rows = []
    for k in range(3):
        r = (m[0][k], m[1][k], m[2][k])
        rows.append([*r, -((r[0] * x + r[1] * y) + r[2] * z)])
    rows.append([0.0, 0.0, 0.0, 1.0])
    return np.array(rows)


def check_rigid(name: str, T_a_b: npt.ArrayLike) -> None:
    """
    Raise ValueError unless a matrix is a rigid transform.

    Parameters
    ----------
    name : str
        Name of the matrix, for the error.
    T_a_b : (4, 4) float
        Rotation orthonormal within 1e-4 and not mirrored, translation below 1e9 m, last row
        0 0 0 1. So a transposed transform is refused.

    """
    matrix = T_a_b if type(T_a_b) is np.ndarray else as_array(name, T_a_b)
    if matrix.shape != (4, 4) or matrix.dtype.kind not in 'fiu':
        raise ValueError(f'{name}: {matrix.dtype} {matrix.shape}, expected float (4, 4)')
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = matrix.tolist()
    products, volume = orthogonality((a, b, c, d, e, f, g, h, i))
    xx, yy, zz, xy, xz, yz = products
    # no loops: this runs for every scan, and in a cold cache each step takes microseconds
    is_normal = abs(xx) <= MAX_SKEW and abs(yy) <= MAX_SKEW and abs(zz) <= MAX_SKEW
    is_square = abs(xy) <= MAX_SKEW and abs(xz) <= MAX_SKEW and abs(yz) <= MAX_SKEW
    is_rotation = is_normal and is_square and volume > 0.0
    limit = MAX_TRANSLATION_M
    is_near = abs(x) < limit and abs(y) < limit and abs(z) < limit
    if not (is_rotation and is_near and last == [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(
            f'{name}: {matrix.tolist()}, expected a rigid transform, rotation and translation '
            f'(below {limit:g} m) above a last row 0 0 0 1'
        )


def orthogonality(entries: Iterable[Any]) -> tuple[tuple[Any, ...], Any]:
    """
    Return how far a matrix R is from a rotation: six entries of R R^T - I, and the determinant.

    Parameters
    ----------
    entries : 9 floats or arrays of one shape
        Row by row, of one matrix or of many.

    Returns
    -------
    products : 6 floats or arrays
        The diagonal, then the upper triangle, of the symmetric R R^T - I.
    volume : float or array
        det R, negative if R mirrors.

    """
    a, b, c, d, e, f, g, h, i = entries
    products = (
        a * a + b * b + c * c - 1.0,
        d * d + e * e + f * f - 1.0,
        g * g + h * h + i * i - 1.0,
        a * d + b * e + c * f,
        a * g + b * h + c * i,
        d * g + e * h + f * i,
    )
    return products, a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def interpolate(T0: Transform, T1: Transform, alpha: float) -> Transform:
    """
    Interpolate two transforms: the translation linearly, the rotation by slerp.

    Parameters
    ----------
    T0, T1 : (4, 4) float64
        Transforms of the same two frames at two times. The rotation takes the shorter way.
    alpha : float
        Weight of T1, in [0, 1]; 0 and 1 return T0 and T1 bit for bit.

    Raises
    ------
    ValueError
        If alpha is not in [0, 1].

    """
    if not 0.0 <= alpha <= 1.0:
        raise ValueError(f'alpha {alpha}: expected a number in [0, 1]; nothing is extrapolated')
    if alpha == 0.0:
        return np.array(T0)
    if alpha == 1.0:
        return np.array(T1)
    q0, q1 = _quaternion(T0), _quaternion(T1)
    if (q0[0] * q1[0] + q0[1] * q1[1]) + (q0[2] * q1[2] + q0[3] * q1[3]) < 0.0:
        q1 = tuple(-v for v in q1)
    # cos(angle) - 1 from the chord: near 0 the cosine itself has no digits of the angle
    dx, dy, dz, dw = (b - a for a, b in zip(q0, q1, strict=True))
    drop = -0.5 * ((dx * dx + dy * dy) + (dz * dz + dw * dw))
    w0, w1 = _slerp_weight(1.0 - alpha, drop), _slerp_weight(alpha, drop)
    q = [w0 * a + w1 * b for a, b in zip(q0, q1, strict=True)]
    t0, t1 = T0[:3, 3].tolist(), T1[:3, 3].tolist()
    return pose_matrix([a + alpha * (b - a) for a, b in zip(t0, t1, strict=True)], q)


def rotation_angle(T_a_b: Transform) -> float:
    """Return the angle of the rotation of a transform, rad, in [0, pi]."""
    x, y, z, w = _quaternion(T_a_b)
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), w)


def se3_exp(xi: npt.NDArray[np.float64]) -> Transform:
    """
    Return the transform of a twist.

    Parameters
    ----------
    xi : (6,) float64
        Translation first: velocity in m, then rotation vector in rad.

    Returns
    -------
    (4, 4) float64
        The matrix exponential of [[phi]x rho; 0 0].

    Raises
    ------
    ValueError
        If the shape is not (6,) or a number is not finite.

    """
    xi = np.asarray(xi, dtype=np.float64)
    if xi.shape != (6,) or not np.isfinite(xi).all():
        raise ValueError(f'twist {xi.tolist()}: expected 6 finite numbers, translation first')
    rho, phi = xi[:3], xi[3:]
    angle_sq = float((phi * phi).sum())
    angle = math.sqrt(angle_sq)
    half_sine = math.sin(0.5 * angle)
    if angle_sq < SMALL_ANGLE_SQ:
        first, second = 0.5 - angle_sq / 24.0, 1.0 / 6.0 - angle_sq / 120.0
        axis = phi * (0.5 - angle_sq / 48.0)
    else:
        first = 2.0 * half_sine * half_sine / angle_sq
        second = (angle - math.sin(angle)) / (angle_sq * angle)
        axis = phi * (half_sine / angle)
    turned = _cross(phi, rho)
    return pose_matrix(
        rho + first * turned + second * _cross(phi, turned), [*axis, math.cos(0.5 * angle)]
    )


def se3_log(T_a_b: Transform) -> npt.NDArray[np.float64]:
    """
    Return the twist of a transform, the inverse of se3_exp.

    Returns
    -------
    (6,) float64
        Translation first: velocity in m, then rotation vector in rad, at most pi long. At pi
        both directions of the vector are valid; one is returned.

    """
    x, y, z, w = _quaternion(T_a_b)
    sine = math.sqrt(x * x + y * y + z * z)
    angle = 2.0 * math.atan2(sine, w)
    phi = np.array([x, y, z]) * (angle / sine if sine > 0.0 else 2.0)
    angle_sq = angle * angle
    if angle_sq < SMALL_ANGLE_SQ:
        second = 1.0 / 12.0 + angle_sq / 720.0
    else:
        # angle / 2 times its cotangent, which is exact near pi, unlike the tangent
        second = (1.0 - 0.5 * angle * (w / sine)) / angle_sq
    t = T_a_b[:3, 3]
    turned = _cross(phi, t)
    return np.concatenate([t - 0.5 * turned + second * _cross(phi, turned), phi])


def face_normals(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """
    Return normals (F, 3) of triangles (F, 3, 3), each as long as twice the area.

    Seen from the side of the normal the corners are in counterclockwise order. np.cross takes
    three times as long on a hundred triangles.
    """
    (ax, ay, az), (bx, by, bz) = (corners[:, k].T - corners[:, 0].T for k in (1, 2))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def _quaternion(T_a_b: Transform) -> tuple[float, ...]:
    """Return the unit quaternion x y z w of a transform, w >= 0."""
    (r00, r01, r02, _), (r10, r11, r12, _), (r20, r21, r22, _), _ = T_a_b.tolist()
    of_w, of_x, of_y, of_z = _candidates(r00, r01, r02, r10, r11, r12, r20, r21, r22)
    if r00 + r11 + r22 > 0.0:
        q = of_w
    elif r00 >= r11 and r00 >= r22:
        q = of_x
    elif r11 >= r22:
        q = of_y
    else:
        q = of_z
    norm = math.sqrt(((q[0] * q[0] + q[1] * q[1]) + q[2] * q[2]) + q[3] * q[3])
    if q[3] < 0.0:
        norm = -norm
    return tuple(v / norm for v in q)


def _candidates(
    r00: Any, r01: Any, r02: Any, r10: Any, r11: Any, r12: Any, r20: Any, r21: Any, r22: Any
) -> tuple[tuple[Any, ...], ...]:
    """Return 4 w q, 4 x q, 4 y q, 4 z q of the quaternion q of a rotation: numbers or arrays."""
    xy, yz, zx = r01 + r10, r12 + r21, r02 + r20
    xw, yw, zw = r21 - r12, r02 - r20, r10 - r01
    return (
        (xw, yw, zw, 1.0 + ((r00 + r11) + r22)),
        (1.0 + ((r00 - r11) - r22), xy, zx, xw),
        (xy, 1.0 + ((r11 - r00) - r22), yz, yw),
        (zx, yz, 1.0 + ((r22 - r00) - r11), zw),
    )


def _slerp_weight(alpha: float, drop: float) -> float:
    """
    Return sin(alpha angle) / sin(angle) for the angle of cosine 1 + drop, -1 <= drop <= 0.

    A power series in drop. All terms are positive, so nothing cancels; each is at most half of
    the previous one, so 50 terms reach the last bit at a right angle, and a few between poses.
    """
    alpha_sq = alpha * alpha
    term = total = alpha
    k = 1
    while term > 1e-17 * total:
        term *= (alpha_sq - k * k) / (k * (2 * k + 1)) * drop
        total += term
        k += 1
    return total


def _cross(a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the cross product of two (3,) vectors; np.cross takes 20 times as long."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
