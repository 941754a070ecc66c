# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Graphs of scans with known poses, for the tests of LUM."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial.transform import Rotation

from surfel_mapper.alignment import LUM


def random_transforms(rng, num, angle_rad, reach_m=3.0):
    """Return the origin and transforms turned by up to an angle about any axis."""
    T = np.tile(np.eye(4), (num, 1, 1))
    for v in range(1, num):
        axis = rng.normal(size=3)
        turn = axis / np.linalg.norm(axis) * angle_rad * rng.uniform(0.5, 1.0)
        T[v, :3, :3] = Rotation.from_rotvec(turn).as_matrix()
        T[v, :3, 3] = rng.uniform(-reach_m, reach_m, 3)
    return T


def make(rng, T, edges, *, sigma=0.01, num=60, offset=0.0, **settings):
    """Return a LUM whose pairs see points about an offset from poses T, with noise."""
    clouds = [[] for _ in T]
    pairs = []
    for ends in edges:
        seen = rng.uniform(-5.0, 5.0, (num, 3)) + offset
        rows = []
        for v in ends:
            local = (seen - T[v, :3, 3]) @ T[v, :3, :3]
            rows.append(np.arange(num) + num * len(clouds[v]))
            clouds[v].append(local + rng.normal(scale=sigma, size=seen.shape))
        pairs.append(np.stack(rows, axis=1))
    lum = LUM(**settings)
    for parts in clouds:
        lum.add_point_cloud(np.concatenate(parts))
    for ends, rows in zip(edges, pairs, strict=True):
        lum.set_correspondences(*ends, rows)
    return lum


def chain(num, loops=()):
    return [*itertools.pairwise(range(num)), *loops]
