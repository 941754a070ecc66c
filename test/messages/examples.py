# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Surfels of random values, for the tests of the formats that carry them."""

import numpy as np

from surfel_mapper.mapping.surfels import Surfels


def make_surfels(number, centre=(0.0, 0.0, 0.0)):
    """Return ``number`` surfels within 50 m of a place, with values of every kind."""
    rng = np.random.default_rng(1)
    normal = rng.normal(size=(number, 3))
    num_points = rng.integers(1, 2**31, number, endpoint=True)
    return Surfels(
        position=rng.uniform(-50.0, 50.0, (number, 3)) + np.array(centre),
        normal=normal / np.linalg.norm(normal, axis=1)[:, None],
        planarity=rng.uniform(size=number),
        curvature=rng.uniform(size=number) / 3.0,
        eigenvalues=np.sort(rng.uniform(0.0, 0.02, (number, 3)), axis=1),
        num_points=num_points,
        voxel_index=rng.integers(-500, 500, (number, 3)).astype(np.int32),
        quality=tuple([rng.uniform(0.0, most, number) for most in (0.1, 1.5, 0.5)]),
        num_scans=rng.integers(1, num_points, endpoint=True),
        size=np.full(number, 0.5),
        covariance=rng.uniform(-0.02, 0.02, (number, 6)),
    )
