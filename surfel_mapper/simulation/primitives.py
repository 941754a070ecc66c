# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Primitive: an analytic surface or solid of a simulated world.

The pose is stored as position and quaternion, not as a matrix, so that a world loaded from its
file gives the same ray casts to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import pose_matrix
from surfel_mapper.simulation.kernels.surfaces import BOX, CYLINDER, RECTANGLE, SPHERE, TUBE

KINDS = {
    'rectangle': (RECTANGLE, ('x', 'y')),
    'box': (BOX, ('x', 'y', 'z')),
    'cylinder': (CYLINDER, ('radius', 'length')),
    'tube': (TUBE, ('radius', 'length')),
    'sphere': (SPHERE, ('radius',)),
}
"""Number of each kind in the kernels, and the names of its sizes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Primitive:
    """
    A surface or solid with a pose.

    Attributes
    ----------
    kind : str
        rectangle: bounded plane z = 0, outward is +z. box: solid. cylinder: about z, with caps;
        tube: without caps. sphere: solid.
    size_m : tuple of float, m
        rectangle: full extent in x and y. box: full extent in x, y and z. cylinder and
        tube: radius and length. sphere: radius.
    xyz : (3,) float, m
        Position of its centre in the world.
    q_xyzw : (4,) float
        Rotation of its axes in the world.
    reflectivity : float
        In [0, 1]; scales the intensity measured by a lidar.
    label : str
        Name of the object: ground, building, car, ...

    Raises
    ------
    ValueError
        If the kind is unknown, the number of sizes is wrong, or a size is not positive and
        finite. If the pose is invalid, or the reflectivity is out of bounds.

    """

    kind: str
    size_m: tuple[float, ...]
    xyz: tuple[float, ...] = (0.0, 0.0, 0.0)
    q_xyzw: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    reflectivity: float = 0.5
    label: str = ''

    def __post_init__(self) -> None:
        """Check every value; convert sequences of numbers to tuples of float."""
        if self.kind not in KINDS:
            raise ValueError(f'kind: {self.kind!r}, expected one of {", ".join(KINDS)}')
        for name in ('size_m', 'xyz', 'q_xyzw'):
            object.__setattr__(self, name, tuple(float(v) for v in getattr(self, name)))
        names = KINDS[self.kind][1]
        if len(self.size_m) != len(names) or not all(0.0 < v < math.inf for v in self.size_m):
            raise ValueError(
                f'size_m of a {self.kind}: {self.size_m}, '
                f'expected {" ".join(names)}, positive and finite'
            )
        if not 0.0 <= self.reflectivity <= 1.0:
            raise ValueError(f'reflectivity: {self.reflectivity}, expected a value in [0, 1]')
        pose_matrix(self.xyz, self.q_xyzw)

    @property
    def T_world_primitive(self) -> npt.NDArray[np.float64]:
        """The pose, (4, 4) float64."""
        return pose_matrix(self.xyz, self.q_xyzw)

    @property
    def half_m(self) -> tuple[float, float, float]:
        """Half the extent along its own axes, m; 0 along z for a rectangle."""
        first = self.size_m[0]
        if self.kind == 'sphere':
            return first, first, first
        if self.kind in ('cylinder', 'tube'):
            return first, first, self.size_m[1] / 2.0
        depth = self.size_m[2] if self.kind == 'box' else 0.0
        return first / 2.0, self.size_m[1] / 2.0, depth / 2.0
