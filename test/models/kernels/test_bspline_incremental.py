# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Incremental fits: their equations and conjugate gradients against the dense system."""

from __future__ import annotations

import numpy as np

from surfel_mapper.models.bspline import HeightField, knots
from surfel_mapper.models.kernels.bspline_incremental import (
    conjugate_gradients,
    equations,
    extrapolate,
    mark_active,
    mark_near,
    second_differences,
)
from test.kernels.modes import both

CELLS = (9, 7)
FIELD = HeightField(0.5, np.array([1.0, -2.0]), (3, 3), np.zeros((CELLS[0] + 2, CELLS[1] + 2)))


def dense(xy):
    """Return the design matrix (M, n) of heights at locations, one control point at a time."""
    columns = []
    for k in range(FIELD.control.size):
        unit = np.zeros(FIELD.control.size)
        unit[k] = 1.0
        field = HeightField(FIELD.pitch_m, FIELD.origin, (3, 3), unit.reshape(FIELD.control.shape))
        columns.append(field.heights(xy))
    return np.stack(columns, axis=1)


def filled_cells():
    filled = np.ones(CELLS, bool)
    filled[3:6, :4] = False
    filled[8] = False
    return filled


@both
def test_active_control_points_are_those_with_influence(call):
    filled, active = filled_cells(), np.zeros(FIELD.control.shape, bool)
    call(mark_active, filled, FIELD.parts(), active)
    cell = np.argwhere(filled)
    inner = np.stack(np.meshgrid(*[np.linspace(0.01, 0.99, 6)] * 2), -1).reshape(-1, 2)
    xy = FIELD.origin + FIELD.pitch_m * (cell[:, None] + inner).reshape(-1, 2)
    influence = (dense(xy) > 1e-12).any(axis=0).reshape(active.shape)
    assert not (influence & ~active).any()
    assert (active.sum() - influence.sum()) <= active.shape[0] + active.shape[1]
    assert len(knots(CELLS[0], 3)) == CELLS[0] + 6

    free = np.zeros_like(active)
    touched = np.zeros(CELLS, bool)
    touched[0, 6] = True
    call(mark_near, touched, 2, active, free)
    expected = np.zeros_like(active)
    expected[0:4, 5:9] = True
    np.testing.assert_array_equal(free, expected & active)


@both
def test_conjugate_gradients_solve_the_dense_system(call):
    filled, rng = filled_cells(), np.random.default_rng(3)
    active = np.zeros(FIELD.control.shape, bool)
    mark_active(filled, FIELD.parts(), active)
    cell = np.argwhere(filled)
    xyz = np.column_stack([FIELD.origin + 0.5 * (cell + 0.5), rng.normal(size=len(cell))])
    first, values = np.empty((len(xyz), 2), np.int64), np.empty((len(xyz), 2, 4))
    num = call(equations, xyz, FIELD.parts(), active, first, values)
    assert num == len(xyz)
    ats, seconds, rows = [], [], []
    for axis, places in enumerate(FIELD.greville()):
        at, second = np.empty((active.size, 2), np.int64), np.empty((active.size, 3))
        count = call(second_differences, places, axis, active, active, at, second)
        ats.append(at[:count])
        seconds.append(second[:count])
        for (begin, step), weights in zip(at[:count], second[:count], strict=True):
            row = np.zeros(active.size)
            row[begin + step * np.arange(3)] = weights
            rows.append(row)
    matrix, bend = dense(xyz[:, :2]), np.array(rows)
    free = np.flatnonzero(active)
    normal = matrix.T @ matrix + 1e-2 * bend.T @ bend + 1e-6 * np.eye(active.size)
    right = matrix.T @ xyz[:, 2]
    expected = np.linalg.solve(normal[np.ix_(free, free)], right[free])
    control = np.zeros(active.size)
    steps = call(
        conjugate_gradients,
        first,
        values,
        np.ascontiguousarray(xyz[first[:, 1], 2]),
        active.shape[1],
        np.concatenate(ats),
        np.concatenate(seconds),
        (1e-2, 1e-6, 1e-12),
        free,
        control,
    )
    assert steps <= 200
    np.testing.assert_allclose(control[free], expected, atol=1e-6)


@both
def test_unknown_control_points_take_the_mean_of_known_neighbours(call):
    control, known, active = np.zeros((4, 4)), np.zeros((4, 4), bool), np.ones((4, 4), bool)
    control[0, 0], control[0, 1], known[0, :2] = 1.0, 3.0, True
    active[3, 3] = False
    call(extrapolate, control, known, active)
    assert control[1, 0] == control[1, 1] == 2.0
    assert control[0, 2] == 3.0
    np.testing.assert_array_equal(known, active)
    assert control[3, 3] == 0.0
