# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Eigenvalues and smallest eigenvectors of 3 by 3 matrices, against numpy.linalg.eigh.

Both solvers are accurate to some 1e-15 of the largest eigenvalue e2. Eigenvalues are compared to
1e-12 e2; a normal moves by the error over the gap e1 - e0 and is compared to 1e-6 rad where
the gap is above 1e-4 e2. Below, it has to be an eigenvector as good as the eigenvalues are.
"""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper.kernels.symmetric3 import decompose
from test.kernels.modes import both, compiled

pytestmark = pytest.mark.filterwarnings('error')


def decomposed(matrices, call=compiled):
    """Return eigenvalues (N, 3) and normals (N, 3) of matrices (N, 3, 3)."""
    num = len(matrices)
    rows, columns = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
    scatter = np.full((6, num + 2), np.nan)
    scatter[:, :num] = np.asarray(matrices)[:, rows, columns].T
    eigenvalues, normals = np.full((3, num + 2), 5.0), np.full((3, num + 2), 5.0)
    call(decompose, scatter, num, eigenvalues, normals)
    assert (eigenvalues[:, num:] == 5.0).all()
    assert (normals[:, num:] == 5.0).all()
    return eigenvalues[:, :num].T, normals[:, :num].T


def with_spectrum(spectrum, seed=0):
    """Return matrices (N, 3, 3) of eigenvalues (N, 3), turned at random."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(len(spectrum), 3, 3)))[0]
    matrices = (axes * np.asarray(spectrum)[:, None, :]) @ axes.transpose(0, 2, 1)
    return (matrices + matrices.transpose(0, 2, 1)) / 2.0


def assert_as_eigh(matrices, call=compiled):
    matrices = np.asarray(matrices, np.float64)
    eigenvalues, normals = decomposed(matrices, call)
    expected, vectors = np.linalg.eigh(matrices)
    largest = np.abs(expected).max(axis=1)

    assert np.isfinite(eigenvalues).all()
    assert (np.diff(eigenvalues, axis=1, prepend=0.0) >= 0.0).all()  # ascending, none negative
    assert (np.abs(eigenvalues - expected).max(axis=1) <= 1e-12 * largest).all()
    assert np.abs(np.linalg.norm(normals, axis=1) - 1.0).max() <= 1e-15

    scale = np.where(largest > 0.0, largest, 1.0)
    moved = np.einsum('nij,nj->ni', matrices / scale[:, None, None], normals)
    rest = moved - (eigenvalues[:, 0] / scale)[:, None] * normals
    assert np.linalg.norm(rest, axis=1).max() <= 1e-12
    apart = expected[:, 1] - expected[:, 0] > 1e-4 * largest
    angle = np.linalg.norm(np.cross(normals, vectors[:, :, 0]), axis=1)
    assert angle[apart].max(initial=0.0) <= 1e-6


def spectra(kind, num, rng):
    """Return eigenvalues (N, 3) of a kind, in no order."""
    small, near = 10.0 ** rng.uniform(-20, -3, (2, num))
    one, any_ = np.ones(num), rng.uniform(size=(3, num))
    return np.stack(
        {
            'random': any_,
            'flat': [one, any_[0], small],
            'disc': [one, 1.0 - near, small],
            'linear': [one, near * small, small],
            'needle': [one, 0.1 * (1.0 - near), 0.1 * one],
            'ball': [one, 1.0 - near, 1.0 - small],
        }[kind],
        axis=1,
    )


KINDS = ['random', 'flat', 'disc', 'linear', 'needle', 'ball']


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('scale', [1.0, 1e-12, 1e18])
def test_matrices_of_every_kind_are_decomposed_as_by_eigh(kind, scale):
    rng = np.random.default_rng(1)
    assert_as_eigh(with_spectrum(spectra(kind, 20_000, rng)) * scale)


@both
@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('scale', [1e-300, 1e-200, 1e-120, 1e120, 1e200, 1e300])
def test_matrices_of_any_scale_are_decomposed(call, kind, scale):
    spectrum = np.maximum(spectra(kind, 60, np.random.default_rng(3)), 1e-5)
    assert_as_eigh(with_spectrum(spectrum) * scale, call)


@both
def test_the_zero_matrix_gives_zeros_and_a_unit_vector(call):
    eigenvalues, normals = decomposed(np.zeros((1, 3, 3)), call)
    assert eigenvalues.tolist() == [[0.0, 0.0, 0.0]]
    assert normals.tolist() == [[0.0, 0.0, 1.0]]


WHOLE = st.integers(-(2**20), 2**20).map(float)


@given(st.tuples(WHOLE, WHOLE, WHOLE), st.tuples(WHOLE, WHOLE, WHOLE))
def test_the_smallest_eigenvalue_of_points_in_a_plane_is_0(a, b):
    normal = np.cross(a, b)
    size = np.linalg.norm(normal)
    if size < 1e-3 * np.linalg.norm(a) * np.linalg.norm(b) or size == 0.0:
        return  # a line, or nearly so
    unit_a, unit_b = np.array(a) / np.linalg.norm(a), np.array(b) / np.linalg.norm(b)
    matrix = np.outer(unit_a, unit_a) + np.outer(unit_b, unit_b)
    eigenvalues, normals = decomposed(matrix[None])
    assert eigenvalues[0, 0] <= 4e-15
    assert np.linalg.norm(np.cross(normals[0], normal / size)) <= 1e-9


ENTRY = st.floats(-1e3, 1e3) | st.sampled_from([0.0, -0.0, 1.0, 1e-9, 1e9, -1.0])


@given(st.lists(st.tuples(ENTRY, ENTRY, ENTRY), min_size=1, max_size=4))
def test_any_sum_of_outer_products_is_decomposed_as_by_eigh(vectors):
    vectors = np.array(vectors)
    assert_as_eigh((vectors.T @ vectors)[None])
