# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Poses of a table, all rows at a time: the twelve numbers of KITTI, or a position and a quaternion.

Rotations of few digits are replaced by the nearest orthonormal ones by the iteration of Newton and
Schulz, X (3 - X^T X) / 2, which needs no decomposition of a matrix: each step squares the error,
so three take 2e-3, the largest one that is accepted, below the resolution of float64.

Sources: Bjorck and Bowie 1971 for the iteration; Higham 1986 for its limit, the polar factor,
which is the nearest rotation in the Frobenius norm.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import MAX_SQUARE_ERROR
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.text_table import Rows
from surfel_mapper.geometry import orthogonality, pose_matrix

logger = logging.getLogger(__name__)

Floats = npt.NDArray[np.float64]

EXACT_SKEW, MAX_SKEW = 1e-5, 2e-3
"""
Largest entries of R R^T - I: of rotations taken as they are, and of those taken at all.

Files of six digits are within the first; the second is that of determinants of 0.999.
"""

STEPS = 3
"""Steps of the iteration: 2e-3, 3e-6, 7e-12, 4e-23."""


def quaternion_rows(rows: Rows, columns: list[int] | slice) -> Floats:
    """
    Return positions and quaternions x y z qx qy qz qw as they are, (R, 7) float64.

    Raises
    ------
    FileFormatError
        With its line, if a row has other than finite numbers, or a squared norm other than
        1 +- 1e-2.

    """
    numbers = rows.numbers(columns)
    with np.errstate(over='ignore'):
        x, y, z, w = np.square(numbers[:, 3:].T)
        square = ((x + y) + z) + w  # in the order of pose_matrix, which refuses the same
    for row in np.flatnonzero(np.abs(square - 1.0) > MAX_SQUARE_ERROR)[:1].tolist():
        try:
            pose_matrix(numbers[row, :3], numbers[row, 3:].tolist())
        except ValueError as error:
            raise FileFormatError(f'{rows.lines.where(row)}: {error}') from error
    return numbers


def matrix_rows(rows: Rows, columns: list[int] | slice) -> tuple[Floats, float]:
    """
    Return poses (R, 4, 4) of three rows of four numbers each, and the largest skew of a rotation.

    Raises
    ------
    FileFormatError
        With its line, if a row has other than finite numbers, or no rotation.

    """
    numbers = rows.numbers(columns)
    poses, skew = rigid_poses(numbers)
    odd = np.flatnonzero(~(skew <= MAX_SKEW))
    if len(odd):
        raise FileFormatError(
            f'{rows.lines.where(odd[0])}: its first three columns are no rotation'
        )
    return poses, float(skew.max(initial=0.0))


def rigid_poses(numbers: Floats) -> tuple[Floats, Floats]:
    """Return the nearest poses, (R, 4, 4), to numbers (R, 12), and the skews of these, (R,)."""
    poses = np.zeros((len(numbers), 4, 4))
    poses[:, :3] = numbers.reshape(-1, 3, 4)
    poses[:, 3, 3] = 1.0
    skew = skew_of(poses[:, :3, :3])
    few = np.flatnonzero((skew > EXACT_SKEW) & (skew <= MAX_SKEW))
    R = poses[few, :3, :3]
    for _ in range(STEPS):
        R = R @ (1.5 * np.eye(3) - 0.5 * R.transpose(0, 2, 1) @ R)
    poses[few, :3, :3] = R
    return poses, skew


def skew_of(matrices: Floats) -> Floats:
    """Return the largest entry of R R^T - I of matrices (R, 3, 3); inf if one is no rotation."""
    entries = np.ascontiguousarray(matrices.reshape(-1, 9).T)
    with np.errstate(over='ignore', invalid='ignore'):
        products, volume = orthogonality(entries)
        skew = np.abs(products).max(axis=0)
    is_near = np.abs(entries).max(axis=0) <= 2.0  # false for nan
    return np.where(is_near & (volume > 0.0), skew, np.inf)


def warn_of_skew(path: str | Path, skew: float) -> None:
    """Warn that rotations in a file are not orthonormal, if they are not."""
    if skew > EXACT_SKEW:
        logger.warning(
            '%s: rotations are not orthonormal, R R^T - I has up to %.2g (at most %g is taken); '
            'the nearest orthonormal ones are used',
            *(path, skew, MAX_SKEW),
        )
