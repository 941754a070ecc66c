# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scans for the tests of filters, and filters made from an item of a chain."""

from __future__ import annotations

import numpy as np

from surfel_mapper.filters.chain import Chain
from surfel_mapper.scan import Scan

FRAME = 'sensor'


def scan_of(points, stamp_ns=10**18, **columns):
    """Return a scan of points, on a robot at the origin of everything."""
    points = np.asarray(points, None if isinstance(points, np.ndarray) else np.float64)
    return Scan(
        points=np.asfortranarray(points.reshape(-1, 3)),
        stamp_ns=stamp_ns,
        frame_id=FRAME,
        columns={name: np.asarray(column) for name, column in columns.items()},
        T_base_sensor=np.eye(4),
        T_map_sensor=np.eye(4),
    )


def random_scan(num_points=500, seed=0, dtype=np.float32):
    """Return a scan with every column that a filter needs, and further ones of clouds."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-4.0, -4.0, -1.0], [4.0, 4.0, 1.0], (num_points, 3)).astype(dtype)
    normals = rng.normal(size=(num_points, 3))
    normals /= np.sqrt((normals**2).sum(axis=1, keepdims=True))
    return scan_of(
        points,
        intensity=rng.uniform(0.0, 255.0, num_points).astype(np.float32),
        ring=rng.integers(0, 64, num_points).astype(np.uint16),
        label=rng.integers(0, 5, num_points).astype(np.int32),
        t=np.sort(rng.integers(0, 10**8, num_points)).astype(np.uint32),
        times=10**18 + np.arange(num_points),
        rgb=rng.integers(0, 2**24, num_points).astype(np.uint32),
        normals=normals.astype(dtype),
        observationDirections=-points,
        densities=rng.uniform(0.0, 100.0, num_points).astype(dtype),
        eigValues=np.sort(rng.uniform(0.0, 1.0, (num_points, 3)), axis=1).astype(dtype),
        eigVectors=np.tile(np.eye(3, dtype=dtype).ravel(), (num_points, 1)),
        incidenceAngles=rng.uniform(0.0, 1.5, num_points).astype(dtype),
    )


def filter_of(name, /, **parameters):
    """Return the filter that a chain makes of a name and parameters."""
    (found,) = Chain.from_list([{name: parameters}]).filters
    return found


def kept(name, points, /, **parameters):
    """Return the indices of the points that a filter keeps; it must not change or reorder them."""
    points = np.asarray(points, None if isinstance(points, np.ndarray) else np.float64)
    scan = scan_of(points, row=np.arange(len(points)))
    found = filter_of(name, **parameters).apply(scan)
    rows = found.columns['row']
    np.testing.assert_array_equal(found.points, scan.points[rows])
    assert (np.diff(rows) > 0).all()
    return rows.tolist()
