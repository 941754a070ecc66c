# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Planes of surfels against a twin in numpy."""

import math

import numpy as np

from surfel_mapper.alignment.kernels.planes import continuation_keys, fill_planes
from surfel_mapper.alignment.surfel_planes import ALIKE, MAX_TILT_SQ, SIGMAS
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap

SIZE_M, NOISE_SQ, MIN_POINTS, RING_SQ = 0.5, 0.02**2, 5, 0.0012


def wall(seed, count=40_000):
    """Return the surfels of a wall in a face between voxels, a leaning one, and scattered ones."""
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-3.0, 3.0, (count, 3))
    flat[:, 1] = rng.normal(1.0, 0.02, count)
    lean = rng.uniform(-3.0, 3.0, (count, 3))
    lean[:, 2] = 0.4 * lean[:, 0] + rng.normal(0.0, 0.02, count)
    surfel_map = SurfelMap(SIZE_M)
    surfel_map.add(np.concatenate([flat, lean, rng.uniform(-3.0, 3.0, (2000, 3))]))
    return surfel_map, surfel_map.surfels()


def expected_keys(surfels):
    keys = np.full(len(surfels), -1)
    for i in range(len(surfels)):
        normal = surfels.normal[i]
        if np.isnan(normal).any():
            continue
        axis = int(np.argmax(np.abs(normal)))
        inside = surfels.position[i, axis] - surfels.voxel_index[i, axis] * SIZE_M
        reach = SIGMAS * math.sqrt(surfels.eigenvalues[i, 0] + NOISE_SQ)
        if min(inside, SIZE_M - inside) * abs(normal[axis]) < reach:
            behind = surfels.voxel_index[i].copy()
            behind[axis] += -1 if inside < 0.5 * SIZE_M else 1
            keys[i] = pack_keys(behind[None])[0]
    return keys


def expected_row(surfels, i, others, j):
    mean, normal = surfels.position[i].copy(), surfels.normal[i].copy()
    e0, e1, count = *surfels.eigenvalues[i, :2], float(surfels.num_points[i])
    if j >= 0:
        off = others.position[j] - mean
        across, cosine = off @ normal, others.normal[j] @ normal
        if abs(cosine) > ALIKE and abs(across) < 2.0 * SIGMAS * math.sqrt(e0 + NOISE_SQ):
            share = others.num_points[j] / (count + others.num_points[j])
            normal = (1.0 - share) * normal + share * math.copysign(1.0, cosine) * others.normal[j]
            normal /= np.linalg.norm(normal)
            mean += share * off
            e0 = (1 - share) * e0 + share * others.eigenvalues[j, 0]
            e0 += share * (1 - share) * across**2
            e1 = (1 - share) * e1 + share * others.eigenvalues[j, 1]
            count += others.num_points[j]
    low = e0 + NOISE_SQ
    spread = low * e1 / (count * max(e1 - e0 - RING_SQ, 1e-9 * low) ** 2)
    is_usable = count >= MIN_POINTS and spread <= MAX_TILT_SQ and not np.isnan(normal).any()
    return [*mean, *normal, low * (1.0 + 1.0 / count) if is_usable else math.inf, spread]


def test_surfels_near_a_face_are_merged_with_their_continuation():
    surfel_map, surfels = wall(seed=1)
    keys = np.empty(len(surfels), np.int64)
    limits = (SIZE_M, NOISE_SQ, SIGMAS)

    continuation_keys(
        surfels.position,
        surfels.normal,
        surfels.eigenvalues,
        surfels.voxel_index,
        limits,
        keys,
    )

    np.testing.assert_array_equal(keys, expected_keys(surfels))
    found = surfel_map.find(keys)
    others = surfel_map.surfels_of(found[found >= 0])
    behind = np.where(found >= 0, np.cumsum(found >= 0) - 1, -1)
    assert 100 < np.count_nonzero(behind >= 0) < len(surfels)
    planes = np.empty((len(surfels), 8))

    fill_planes(
        (surfels.position, surfels.normal, surfels.eigenvalues, surfels.num_points),
        (others.position, others.normal, others.eigenvalues, others.num_points),
        behind,
        (NOISE_SQ, SIGMAS, ALIKE, MIN_POINTS, MAX_TILT_SQ, RING_SQ),
        planes,
    )

    expected = [expected_row(surfels, i, others, j) for i, j in enumerate(behind)]
    np.testing.assert_allclose(planes, expected, rtol=1e-9, atol=1e-12)
    assert 0 < np.isinf(planes[:, 6]).sum() < len(planes)
