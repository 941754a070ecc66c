# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Invariants of every surfel, and bounds of its rounding, for the tests of Surfel.

Tolerances. EPS = 2^-52. One step of float64 may be off by a few EPS of the largest scatter held on
the way (removing leaves the rounding of the removed points), and steps add up as a random walk of
half an EPS each: ``rounding(steps)`` = (4 + sqrt(steps) / 2) EPS.
"""

from hypothesis import strategies as st
import numpy as np
import pytest

EPS = np.finfo(np.float64).eps
UNIT = 16 * EPS  # LAPACK's eigenvectors: 8.5 EPS were found in 10^4 examples
# The lattice of 2^-10 m: sums, and the shift to 10 km, are exact in float64.
LATTICE = st.integers(-512, 512).map(lambda k: k / 1024)
POINT = st.tuples(LATTICE, LATTICE, LATTICE).map(np.array)
POINTS = st.lists(POINT, min_size=1, max_size=12).map(np.array)
FAR_M = np.array([6000.0, -6400.0, 4800.0])


def rounding(steps):
    return (4.0 + np.sqrt(steps) / 2.0) * EPS


def trace(surfel):
    return surfel.sum_squares[[0, 3, 5]].sum()


def assert_normal(normal, expected, tolerance):
    """Compare normals up to their sign."""
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=UNIT)
    np.testing.assert_allclose(
        normal * np.sign(normal @ expected), expected, rtol=0, atol=tolerance
    )


def assert_promises(surfel):
    """Assert the invariants of a surfel."""
    n, values, vectors = surfel.num_points, surfel.eigenvalues(), surfel.eigenvectors()
    assert surfel.empty == (n == 0)
    assert np.isnan(surfel.mean()).all() == (n == 0)
    assert np.isfinite(values).all()
    assert (values >= 0.0).all()
    assert (np.diff(values) >= 0.0).all()
    if n < 2:
        assert not values.any()
        assert not surfel.covariance().any()
    if values[2] == 0.0:
        assert np.isnan(vectors).all()
        assert np.isnan(surfel.normal()).all()
        assert np.isnan(surfel.planarity())
        assert np.isnan(surfel.curvature())
    else:
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), rtol=0, atol=UNIT)
        np.testing.assert_array_equal(surfel.normal(), vectors[:, 0])
        assert (vectors.max(axis=0) >= -vectors.min(axis=0)).all()
        assert 0.0 <= surfel.planarity() <= 1.0
        assert 0.0 <= surfel.curvature() <= 1 / 3
