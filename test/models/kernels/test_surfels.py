# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Classes, links and groups of surfels against numpy, scipy and brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as scipy_components

from surfel_mapper.models.kernels.surfel_classes import (
    across,
    classify,
    classify_sparse,
    FLAT,
    mark_material,
    NONE,
    ROUGH,
    YOUNG,
)
from surfel_mapper.models.kernels.surfel_groups import (
    common_labels,
    connected_components,
    find_doubtful,
    find_pieces,
    mean_normals,
    merge_voxels,
    name_components,
    rows_of_groups,
    sample_voxels,
    sort_by_group,
)
from surfel_mapper.models.kernels.surfel_links import (
    find_hosts,
    link_neighbours,
    ROUNDS,
    spread,
    unlink,
    update_links,
)
from test.kernels.modes import both

PAIRS = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
SIZE_M = 0.5
RULES = (math.cos(math.radians(15.0)), 0.05, math.cos(math.radians(30.0)), 0.025, 1e9)


def blobs(number, seed):
    """Return clouds of points of random shapes, some flat, some lines."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(number):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        scale = rng.choice([0.1, 0.01, 0.001], 3)
        found.append((rng.normal(size=(rng.integers(4, 60), 3)) * scale) @ turn.T + 7.0)
    return found


def packed(clouds):
    covariances = np.array([np.cov(cloud.T) for cloud in clouds])
    counts = np.array([len(cloud) for cloud in clouds])
    means = np.array([cloud.mean(axis=0) for cloud in clouds])
    return counts, means, covariances[:, PAIRS[0], PAIRS[1]], covariances


@both
def test_classes_and_axes_equal_the_eigen_decomposition(call):
    clouds = blobs(60, 1)
    counts, _, six, full = packed(clouds)
    values, vectors = np.linalg.eigh(full)
    normals = np.ascontiguousarray(vectors[:, :, 0])
    kind, axes = np.zeros(60, np.uint8), np.zeros((60, 2, 3))
    rows, variance = np.arange(60, dtype=np.int32), 1e-4
    call(classify, rows, counts, normals, six, (10.0, variance, SIZE_M), kind, axes)
    is_flat = (values[:, 0] < variance) & (values[:, 1] > 0.04 * values[:, 2])
    expected = np.where(counts < 10, YOUNG, np.where(is_flat, FLAT, ROUGH))
    assert kind.tolist() == expected.tolist()
    assert len({*kind.tolist()}) == 3
    for row in range(60):
        lengths = np.minimum(np.sqrt(3.0 * values[row, :0:-1]), SIZE_M * math.sqrt(0.5))
        along = axes[row] / lengths[:, None]
        expected = vectors[row, :, :0:-1].T
        assert np.abs((along * expected).sum(axis=1)) == pytest.approx([1.0, 1.0], abs=1e-6)
        assert np.linalg.norm(along, axis=1) == pytest.approx([1.0, 1.0], abs=1e-6)


@both
def test_tangents_are_orthonormal(call):
    for normal in np.concatenate(
        [np.eye(3), -np.eye(3), np.random.default_rng(2).normal(size=(20, 3))]
    ):
        unit = normal / np.linalg.norm(normal)
        basis = np.array([*np.reshape(call(across, *unit), (2, 3)), unit])
        np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-14)


@both
def test_changes_are_material_beyond_each_threshold(call):
    count, kind = np.array([100, 100, 120, 100, 100]), np.full(5, FLAT, np.uint8)
    position, normal = np.zeros((5, 3)), np.tile([0.0, 0.0, 1.0], (5, 1))
    reported = np.full(5, 100), np.zeros((5, 3)), normal.copy()
    position[1, 0], normal[3] = 0.011, (0.1, 0.0, math.sqrt(0.99))
    before, material = np.array([FLAT, FLAT, FLAT, FLAT, YOUNG], np.uint8), np.zeros(5, bool)
    rules = (0.01**2, math.cos(math.radians(2.0)), 1.2)
    rows = np.arange(5, dtype=np.int32)
    call(mark_material, rows, before, count, position, normal, kind, reported, rules, material)
    assert material.tolist() == [False, True, True, True, True]
    assert reported[0].tolist() == [100, 100, 120, 100, 100]
    np.testing.assert_array_equal(reported[1], position)


def grid_of_surfels(seed):
    """Return neighbour table, classes, positions and normals of random voxels on a lattice."""
    rng = np.random.default_rng(seed)
    steps = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    half = [step for step in steps if step > (0, 0, 0)]
    steps = half + [tuple(-np.array(step)) for step in half]
    voxels = [tuple(v) for v in np.argwhere(rng.random((6, 6, 3)) < 0.7).tolist()]
    row = {voxel: k for k, voxel in enumerate(voxels)}
    table = np.array(
        [[row.get(tuple(np.add(v, step).tolist()), -1) for step in steps] for v in voxels],
        np.int32,
    )
    kind = rng.choice([YOUNG, FLAT, FLAT, FLAT, ROUGH], len(voxels)).astype(np.uint8)
    position = 0.1 * (np.array(voxels) + rng.uniform(0.4, 0.6, (len(voxels), 3)))
    normal = np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, 0.15, (len(voxels), 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return table, kind, position, normal


def brute_links(table, kind, position, normal):
    """Return the links of all pairs, (R, H) bool."""
    half = table.shape[1] // 2
    found = np.zeros((len(table), half), bool)
    for i in range(len(table)):
        for h in range(half):
            j = table[i, h]
            if j < 0 or kind[i] != FLAT or kind[j] != FLAT:
                continue
            delta = position[i] - position[j]
            one, other, cosine = normal[i] @ delta, normal[j] @ delta, normal[i] @ normal[j]
            on_plane = abs(cosine) > RULES[0] and 0.5 * (abs(one) + abs(other)) < RULES[1]
            on_arc = cosine > RULES[2] and 0.5 * abs(one + other) < RULES[3]
            found[i, h] = on_plane or on_arc
    return found


def bits(links, half):
    return (links[:, None] >> np.arange(half, dtype=np.uint64) & np.uint64(1)).astype(bool)


@both
def test_links_follow_changes_and_equal_brute_force(call):
    table, kind, position, normal = grid_of_surfels(3)
    num, half = len(table), table.shape[1] // 2
    neighbours, links = np.full_like(table, -1), np.zeros(num, np.uint64)
    marks, marked = np.zeros(num, bool), np.empty(num, np.int32)
    rng = np.random.default_rng(4)
    order = rng.permutation(num).astype(np.int32)
    is_chosen, present = np.zeros(num, bool), np.zeros(num, bool)
    for part in np.array_split(order, 3):
        present[part] = True
        found = np.where((table >= 0) & present[table], table, -1)[part]
        call(link_neighbours, part, found, neighbours)
        is_chosen[part] = True
        state = kind, position, normal, kind
        count = call(
            update_links, part, is_chosen, neighbours, state, RULES, links, marks, marked, 0
        )
        is_chosen[part] = marks[marked[:count]] = False
    np.testing.assert_array_equal(neighbours, table)
    expected = brute_links(table, kind, position, normal)
    np.testing.assert_array_equal(bits(links, half), expected)
    assert expected.sum() > 30

    gone = order[:20]
    count = call(unlink, gone, neighbours, links, marks, marked)
    left = np.where(np.isin(table, gone), -1, table)
    left[gone] = -1
    np.testing.assert_array_equal(neighbours, left)
    after = brute_links(left, kind, position, normal)
    np.testing.assert_array_equal(bits(links, half), after)
    lost = np.argwhere(expected & ~after)
    # links stored at removed rows go with them
    ends = {int(i) for i, _ in lost if i not in gone}
    assert ends
    assert ends <= set(marked[:count].tolist())


@both
def test_components_equal_scipy_and_are_named_by_the_least_key(call):
    table, kind, position, normal = grid_of_surfels(5)
    num, half = len(table), table.shape[1] // 2
    matrix = brute_links(table, kind, position, normal)
    links = (matrix << np.arange(half)).sum(axis=1).astype(np.uint64)
    i, h = np.nonzero(matrix)
    _, expected = scipy_components(coo_array((np.ones(len(i)), (i, table[i, h])), (num, num)))
    rows = np.flatnonzero(kind == FLAT).astype(np.int32)
    places, parent = np.full(num, -1, np.int32), np.empty(len(rows), np.int64)
    call(connected_components, rows, links, table, places, parent)
    assert (places == -1).all()
    same = parent[:, None] == parent[None]
    np.testing.assert_array_equal(same, expected[rows][:, None] == expected[rows][None])

    key, component = np.random.default_rng(6).permutation(num), np.full(num, -1, np.int32)
    call(name_components, rows, parent, key, component)
    for name in np.unique(component[rows]):
        members = np.flatnonzero(component == name)
        assert members[key[members].argmin()] == name


def brute_hosts(table, kind, position, normal, six, rules):
    """Return host and round of every voxel that is not flat, round by round."""
    host, level = np.full(len(kind), -1), np.zeros(len(kind), int)
    for step in range(1, ROUNDS + 1):
        before, was = host.copy(), level.copy()
        for row in np.flatnonzero((kind != FLAT) & (was == 0)):
            near = [j for j in table[row] if j >= 0]
            if step == 1:
                roots = [j for j in near if kind[j] == FLAT]
            else:
                roots = [before[j] for j in near if kind[j] != FLAT and was[j] == step - 1]
            found = [
                (abs(normal[j] @ (position[row] - position[j])), k, j)
                for k, j in enumerate(roots)
                if normal[j] ** 2 @ six[row, [0, 3, 5]] < rules[1]
                and abs(normal[j] @ (position[row] - position[j])) < rules[0]
            ]
            if found:
                host[row], level[row] = min(found)[2], step
    return host, level


@both
def test_hosts_grow_round_by_round_over_the_nearest_planes(call):
    table, kind, position, normal = grid_of_surfels(7)
    kind[np.random.default_rng(3).random(len(kind)) < 0.7] = YOUNG
    six = np.abs(np.random.default_rng(8).normal(0.0, 1e-4, (len(table), 6)))
    six[:, [1, 2, 4]] = 0.0
    chosen = np.flatnonzero(kind != FLAT).astype(np.int32)
    host, level = np.full(len(kind), -1, np.int32), np.zeros(len(kind), np.uint8)
    rules, state = (0.05, 1e-4, 1e9), (kind, position, normal)
    call(find_hosts, chosen, table, state, six, rules, host, level)
    expected = brute_hosts(table, kind, position, normal, six, rules)
    assert host.tolist() == expected[0].tolist()
    assert level.tolist() == expected[1].tolist()
    assert {1, 2} <= set(level.tolist())
    assert NONE == 0

    # after a change, the voxels around it are enough
    kind[chosen[5]] = FLAT
    host[chosen[5]], level[chosen[5]] = -1, 0
    found, marks = np.empty(len(kind), np.int32), np.zeros(len(kind), bool)
    around = found[: call(spread, chosen[5:6], table, ROUNDS, marks, found)]
    rest = around[kind[around] != FLAT]
    call(find_hosts, rest, table, state, six, rules, host, level)
    expected = brute_hosts(table, kind, position, normal, six, rules)
    assert host.tolist() == expected[0].tolist()


@both
def test_spread_lists_all_within_some_steps(call):
    table, kind, _, _ = grid_of_surfels(11)
    marks, found = np.zeros(len(kind), bool), np.empty(len(kind), np.int32)
    start = np.array([3, -1, 40], np.int32)
    expected = {3, 40}
    for steps in range(3):
        num = call(spread, start, table, steps, marks, found)
        assert len(set(found[:num].tolist())) == num
        assert set(found[:num].tolist()) == expected
        assert not marks.any()
        expected |= {int(j) for i in expected for j in table[i] if j >= 0}


@both
def test_sparse_voxels_are_flat_on_the_plane_of_all_points_around(call):
    rng = np.random.default_rng(14)
    table = np.array([[1, 2, -1], [0, 2, -1], [0, 1, 3], [2, -1, -1]], np.int32)
    tilt = np.array([[1.0, 0.0, 0.1], [0.0, 1.0, 0.0], [-0.1, 0.0, 1.0]])
    clouds = [
        (rng.uniform(0.0, 0.4, (6, 3)) * [1, 1, 1e-3] + [0.5 * k, 0.0, 0.0]) @ tilt.T
        for k in range(4)
    ]
    clouds[3][:, 2] += 0.2  # off the plane of the others
    counts, means, six, full = packed(clouds)
    values, vectors = np.linalg.eigh(full)
    normals = np.ascontiguousarray(vectors[:, :, 0]) * np.sign(vectors[:, 2:, 0])
    own = np.full(4, YOUNG, np.uint8)
    kind, normal = np.zeros(4, np.uint8), np.empty((4, 3))
    rows, alone = np.arange(4, dtype=np.int32), (counts, means, normals, six, values)
    rules = (15.0, 1e-4, SIZE_M)
    call(classify_sparse, rows, table, own, alone, rules, kind, normal)
    assert kind.tolist() == [FLAT, FLAT, YOUNG, YOUNG]
    pooled = np.concatenate(clouds[:3])
    expected = np.linalg.eigh(np.cov(pooled.T))[1][:, 0]
    np.testing.assert_allclose(normal[0], expected * np.sign(expected[2]), atol=1e-9)
    np.testing.assert_array_equal(normal[3], normals[3])

    own[1] = FLAT  # beside it they may get a host instead
    call(classify_sparse, rows, table, own, alone, rules, kind, normal)
    assert kind.tolist() == [YOUNG, FLAT, YOUNG, YOUNG]


@both
def test_merged_moments_equal_those_of_all_points(call):
    clouds = blobs(12, 9)
    counts, means, six, _ = packed(clouds)
    rows, starts = np.arange(12, dtype=np.int32), np.array([0, 5, 6, 12])
    total, mean, merged = np.empty(3, np.int64), np.empty((3, 3)), np.empty((3, 6))
    call(merge_voxels, rows, starts, counts, means, six, total, mean, merged)
    for k in range(3):
        points = np.concatenate(clouds[starts[k] : starts[k + 1]])
        assert total[k] == len(points)
        np.testing.assert_allclose(mean[k], points.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(merged[k], np.cov(points.T)[PAIRS], atol=1e-12)


@both
def test_rows_are_sorted_by_group_and_stable(call):
    rng = np.random.default_rng(10)
    group, rows = rng.integers(0, 9, 40).astype(np.int32), rng.permutation(40).astype(np.int32)
    places, ordered = np.full(40, -1, np.int32), np.empty(40, np.int32)
    starts = np.empty(41, np.int64)
    num = call(sort_by_group, rows, group, places, ordered, starts)
    names = list(dict.fromkeys(group[rows].tolist()))
    expected = [[r for r in rows.tolist() if group[r] == name] for name in names]
    found = [ordered[starts[k] : starts[k + 1]].tolist() for k in range(num)]
    assert found == expected

    flags, extra, listed = np.zeros(40, bool), np.zeros(40, bool), np.empty(40, np.int32)
    flags[2], extra[7], group[8] = True, True, -1
    count = call(rows_of_groups, group, flags, extra, listed)
    assert listed[:count].tolist() == [r for r in range(40) if group[r] == 2 or r == 7]


@both
def test_mean_normals_ignore_signs_without_a_viewpoint(call):
    up = np.tile([0.0, 0.6, 0.8], (10, 1))
    mixed = up * np.where(np.arange(10) < 6, 1.0, -1.0)[:, None]
    normal = np.concatenate([up, mixed, [[1.0, 0.0, 0.0]]])
    flat = np.arange(21) < 20
    means, starts = np.empty((2, 3)), np.array([0, 10, 21])
    rows = np.arange(21, dtype=np.int32)
    call(mean_normals, rows, starts, flat, normal, means)
    np.testing.assert_allclose(means, np.tile([0.0, 0.6, 0.8], (2, 1)), atol=1e-12)
    position, found = np.zeros((21, 3)), np.empty(2, bool)
    call(find_doubtful, rows, starts, means, normal, position, (0.5, 1.0), found)
    assert found.tolist() == [False, True]
    position[3] = 1.01 * means[0]
    call(find_doubtful, rows, starts, means, normal, position, (0.5, 1.0), found)
    assert found.tolist() == [True, True]


@both
def test_samples_of_surfels_are_three_by_three_and_stay_in_their_voxel(call):
    position, axes = np.array([[0.25, 0.25, 0.25]]), np.zeros((1, 2, 3))
    axes[0, 0, 0], axes[0, 1, 1] = 0.1, 0.4
    points = np.empty((9, 3))
    call(sample_voxels, np.zeros(1, np.int32), position, axes, np.zeros((1, 3)), SIZE_M, points)
    x, y = np.meshgrid([0.15, 0.25, 0.35], [0.0, 0.25, 0.5], indexing='ij')
    np.testing.assert_allclose(points[:, :2], np.stack([x, y], -1).reshape(-1, 2), atol=1e-15)
    assert (points[:, 2] == 0.25).all()


@both
def test_pieces_are_named_by_the_least_key_of_each_group_in_each_block(call):
    rng = np.random.default_rng(11)
    owner = rng.integers(-1, 6, 500).astype(np.int32)
    block, key = rng.integers(0, 4, 500).astype(np.int32), rng.permutation(500)
    piece = np.empty(500, np.int32)
    call(find_pieces, owner, block, key, piece)
    assert (piece[owner < 0] == -1).all()
    for row in np.flatnonzero(owner >= 0):
        mine = np.flatnonzero((owner == owner[row]) & (block == block[row]))
        assert piece[row] == mine[key[mine].argmin()]


@both
def test_common_labels_are_of_groups_of_one_label(call):
    labels = np.array([3, 3, 3, -1, -1, 5, 3, 7], np.int32)
    found = np.empty(4, np.int64)
    call(common_labels, labels, np.array([0, 3, 5, 7, 8]), found)
    assert found.tolist() == [3, -1, -1, 7]
