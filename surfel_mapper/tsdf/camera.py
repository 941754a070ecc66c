# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The pinhole camera that measures depth.

An integer pixel (column u, row v) is the ray through (u, v), without half-pixel offsets, when an
image is made as well as when it is read. Frame: z ahead, x right, y down.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.projection import CAMERA
from surfel_mapper.tsdf.sensor_checks import range_checks, refuse_unless

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Camera:
    """
    A pinhole camera that measures depth.

    Attributes
    ----------
    columns, rows : int
        Size of its images.
    fx, fy, cx, cy : float
        Intrinsics, pixels.
    min_range_m, max_range_m : float
        What is nearer is ignored; what is farther says that there is nothing up to max_range_m.

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

    wraps = False
    kind = CAMERA

    def __post_init__(self) -> None:
        """Check every value."""
        checks = [
            *range_checks(self),
            ('fx', 0.0 < self.fx < math.inf, 'positive, finite'),
            ('fy', 0.0 < self.fy < math.inf, 'positive, finite'),
            ('cx', 0.0 < self.cx <= self.columns, 'positive, at most the number of columns'),
            ('cy', 0.0 < self.cy <= self.rows, 'positive, at most the number of rows'),
        ]
        refuse_unless(self, checks)

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
    def parameters(self) -> Float32:
        """What the kernels need to project, see kernels/projection.py."""
        return np.array(
            [self.fx, self.fy, self.cx, self.cy, self.columns, self.rows, 0.0, 0.0], np.float32
        )

    @cached_property
    def elevations(self) -> Float32:
        """Nothing: rows of a camera are not at one elevation."""
        return np.zeros(0, np.float32)

    @property
    def projection(self) -> tuple[Any, ...]:
        """What the kernels take: kind, parameters, elevations."""
        return self.kind, self.parameters, self.elevations

    @property
    def density(self) -> float:
        """Rays that a face of 1 m^2 at depth 1 m meets."""
        return self.fx * self.fy

    @property
    def pitch_rad(self) -> tuple[float, float]:
        """Largest angles between neighbouring rows and columns."""
        return 1.0 / self.fy, 1.0 / self.fx

    def sees(self, centres: Float64, inflation_m: float) -> npt.NDArray[np.bool_]:
        """Return which balls about (K, 3) centres in its frame reach into its view."""
        corners = [(0.0, 0.0), (self.columns, 0.0), (self.columns, self.rows), (0.0, self.rows)]
        rays = np.array(
            [((u - self.cx) / self.fx, (v - self.cy) / self.fy, 1.0) for u, v in corners]
        )
        normals = np.cross(rays, np.roll(rays, -1, axis=0))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        within = centres[:, 2] >= -inflation_m
        inside: npt.NDArray[np.bool_] = within & (centres @ normals.T >= -inflation_m).all(axis=1)
        return inside
