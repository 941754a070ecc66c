# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Voxels of a map against the points of one scan: same classes, same primitives.

The twin uses points only: it groups them by voxel, takes numpy's covariances and walks from
neighbour to neighbour. It shares the tests with the single-cloud fit, not the code.
"""

from __future__ import annotations

from itertools import product
import math

import numpy as np
import pytest

from surfel_mapper.config import ModelsLayerConfig
from test.models.live_scenes import groups, of_points
from test.models.scenes import BALL, CYLINDER, room, VIEW

VOXEL_M, MIN_POINTS, MIN_VOXELS, THICKNESS_M = 0.1, 6, 4, 0.03
SETTINGS = ModelsLayerConfig(
    min_points=MIN_POINTS,
    min_voxels=MIN_VOXELS,
    flat_thickness_m=THICKNESS_M,
    noise_m=1e-9,  # stated, so that it is not estimated: the twin knows the thickness alone
)
NEAR = [step for step in product((-1, 0, 1), repeat=3) if step != (0, 0, 0)]


@pytest.fixture(scope='module')
def frame():
    points, lies_on = room(320, 240, noise_per_range_sq=4e-4)
    flat = (lies_on != CYLINDER) & (lies_on != BALL)  # nothing that has to be cut
    return points[flat].astype(np.float64)


def surfels_of(points):
    """Return (class, mean, normal, covariance) of every voxel by its index."""
    number, found = np.floor(points / VOXEL_M).astype(int), {}
    order = np.lexsort(number.T)
    ends = np.flatnonzero(np.diff(number[order], axis=0).any(axis=1)) + 1
    for rows in np.split(order, ends):
        own, voxel = points[rows], tuple(number[rows[0]].tolist())
        mean = own.mean(axis=0)
        covariance = np.cov(own.T) if len(own) > 1 else np.zeros((3, 3))
        values, vectors = np.linalg.eigh(covariance)
        normal = vectors[:, 0] * math.copysign(1.0, vectors[:, 0] @ (VIEW - mean))
        is_thin = 6.0 * math.sqrt(max(values[0], 0.0)) < THICKNESS_M
        is_flat = is_thin and values[1] > 0.04 * values[2]
        kind = 'young' if len(own) < MIN_POINTS else 'flat' if is_flat else 'rough'
        found[voxel] = kind, mean, normal, covariance
    return found


def same_surface_products(one, other):
    """Return whether two neighbours are of one plane or one arc."""
    delta, cosine = one[1] - other[1], one[2] @ other[2]
    first, second = one[2] @ delta, other[2] @ delta
    on_plane = abs(cosine) > math.cos(math.radians(15.0)) and (
        0.5 * (abs(first) + abs(second)) < THICKNESS_M
    )
    on_arc = cosine > math.cos(math.radians(30.0)) and (
        0.5 * abs(first + second) < 0.5 * THICKNESS_M
    )
    return on_plane or on_arc


def neighbours(voxel, pieces):
    """Return the voxels around one that hold points."""
    around = (tuple(np.add(voxel, step).tolist()) for step in NEAR)
    return [other for other in around if other in pieces]


def components(pieces):
    """Return the connected components of flat voxels."""
    left, found = {v for v, piece in pieces.items() if piece[0] == 'flat'}, []
    while left:
        waiting, members = [left.pop()], set()
        while waiting:
            voxel = waiting.pop()
            members.add(voxel)
            for other in neighbours(voxel, pieces):
                if other in left and same_surface_products(pieces[voxel], pieces[other]):
                    left.remove(other)
                    waiting.append(other)
        found.append(members)
    return found


def twin(points):
    """Return the result of groups() from points alone."""
    pieces = surfels_of(points)
    owner = {}
    for members in components(pieces):
        for voxel in members:
            owner[voxel] = frozenset(members) if len(members) >= MIN_VOXELS else None
    joined = {members: set(members) for members in owner.values() if members}
    for voxel, (kind, mean, _, covariance) in pieces.items():
        if kind == 'flat':
            continue
        near = [
            (abs(pieces[other][2] @ (mean - pieces[other][1])), other)
            for other in neighbours(voxel, pieces)
            if pieces[other][0] == 'flat'
            and 36.0 * pieces[other][2] @ covariance @ pieces[other][2] < THICKNESS_M**2
        ]
        away, host = min(near, default=(math.inf, None))
        if away < THICKNESS_M and owner[host]:
            joined[owner[host]].add(voxel)
            owner[voxel] = owner[host]
    result = {('patch', frozenset(members)) for members in joined.values()}
    rest = [voxel for voxel in pieces if not owner.get(voxel)]
    result |= {('gaussian', frozenset([v])) for v in rest if pieces[v][0] != 'young'}
    young = frozenset(v for v in rest if pieces[v][0] == 'young')
    return result | ({('none', young)} if young else set())


def test_map_of_one_scan_equals_the_twin_on_its_points(frame):
    _, models = of_points(frame, VIEW, SETTINGS, VOXEL_M)
    expected = twin(frame)
    kinds = [kind for kind, _ in expected]
    assert kinds.count('patch') >= 6
    assert kinds.count('gaussian') > 50
    assert groups(models) == expected
