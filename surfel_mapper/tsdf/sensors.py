# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Projection model of a depth camera: which ray each pixel of a range image stands for.

x right, y down, z ahead. An integer pixel (column u, row v) is the ray through (u, v), without
half-pixel offsets, both when a range image is made and when it is read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError

MAX_PIXELS = 1 << 26
"""Limit of rows * columns: a range image of 256 MB."""


Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class CameraModel:
    """
    Projection model of a pinhole depth camera.

    Attributes
    ----------
    columns, rows : int
        Size of its images.
    fx, fy, cx, cy : float
        Intrinsics, pixels.
    min_range_m, max_range_m : float
        Nearer returns are ignored; farther ones only free the space up to max_range_m.

    Raises
    ------
    ConfigError
        If a value is out of bounds.

    """

    columns: int
    rows: int
    fx: float
    fy: float
    cx: float
    cy: float
    min_range_m: float = 0.1
    max_range_m: float = 8.0

    def __post_init__(self) -> None:
        """Check every value."""
        checks = (
            ('rows', self.rows >= 1, 'at least 1'),
            ('columns', self.columns >= 1, 'at least 1'),
            ('columns', self.rows * self.columns <= MAX_PIXELS, f'at most {MAX_PIXELS} pixels'),
            ('min_range_m', 0.0 < self.min_range_m < math.inf, 'positive, finite'),
            (
                'max_range_m',
                self.min_range_m < self.max_range_m < math.inf,
                'more than min_range_m, finite',
            ),
            ('fx', 0.0 < self.fx < math.inf, 'positive, finite'),
            ('fy', 0.0 < self.fy < math.inf, 'positive, finite'),
            ('cx', 0.0 < self.cx <= self.columns, 'positive, at most the number of columns'),
            ('cy', 0.0 < self.cy <= self.rows, 'positive, at most the number of rows'),
        )
        for name, holds, expected in checks:
            if not holds:
                raise ConfigError(
                    f'CameraModel.{name}: {getattr(self, name)}, expected {expected}'
                )

    @cached_property
    def ray_length(self) -> Float32:
        """Range of each pixel at depth 1, (rows, columns)."""
        x = (np.arange(self.columns) - self.cx) / self.fx
        y = (np.arange(self.rows) - self.cy) / self.fy
        length: Float32 = np.asarray(np.sqrt(x * x + (y * y)[:, None] + 1.0), np.float32)
        return length

    @cached_property
    def directions(self) -> Float32:
        """Unit vector of each pixel, (rows, columns, 3)."""
        rays = np.empty((self.rows, self.columns, 3))
        rays[:, :, 0] = (np.arange(self.columns) - self.cx) / self.fx
        rays[:, :, 1] = ((np.arange(self.rows) - self.cy) / self.fy)[:, None]
        rays[:, :, 2] = 1.0
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        return rays.astype(np.float32)

    @cached_property
    def projection(self) -> Float32:
        """Intrinsics and size, the form that kernels take."""
        numbers = [self.fx, self.fy, self.cx, self.cy, self.columns, self.rows]
        return np.array(numbers, np.float32)

    @property
    def pitch_rad(self) -> tuple[float, float]:
        """Largest angles between neighbouring rows and columns."""
        return 1.0 / self.fy, 1.0 / self.fx
