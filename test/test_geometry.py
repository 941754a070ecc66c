# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Rigid transforms against scipy.spatial.transform and scipy.linalg, which use other formulas.

Tolerances are in units of the rounding of float64, EPS = 2^-52, times the few operations on
numbers of order 1; translations count relative to their length.
"""

import math

from hypothesis import example, given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation, Slerp

from surfel_mapper.geometry import (
    compose,
    face_normals,
    interpolate,
    inverse,
    pose_matrix,
    q_xyzw,
    quaternions,
    rotation_angle,
    se3_exp,
    se3_log,
)

EPS = np.finfo(np.float64).eps

ANGLES = st.one_of(
    st.floats(0.0, math.pi),
    st.sampled_from([0.0, 1e-300, 1e-12, 1e-9, 0.99e-4, 1.01e-4, 1e-3]),
    st.sampled_from([1e-300, 1e-12, 1e-8, 1e-4]).map(lambda short: math.pi - short),
)
AXES = (
    st.tuples(*[st.integers(-5, 5)] * 3).filter(any).map(lambda a: np.array(a) / np.linalg.norm(a))
)
ROTATION_VECTORS = st.builds(lambda axis, angle: axis * angle, AXES, ANGLES)
METRES = st.floats(-1e4, 1e4)
VECTORS = st.tuples(METRES, METRES, METRES).map(np.array)


def twin_matrix(rotation_vector, xyz):
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    T_a_b[:3, 3] = xyz
    return T_a_b


TRANSFORMS = st.builds(
    lambda rotvec, xyz: pose_matrix(xyz, Rotation.from_rotvec(rotvec).as_quat()),
    ROTATION_VECTORS,
    VECTORS,
)


@given(ROTATION_VECTORS, VECTORS)
def test_a_pose_is_the_matrix_of_its_rotation_and_translation(rotvec, xyz):
    T_a_b = pose_matrix(xyz, Rotation.from_rotvec(rotvec).as_quat())

    np.testing.assert_allclose(T_a_b, twin_matrix(rotvec, xyz), rtol=0, atol=8 * EPS)
    np.testing.assert_array_equal(T_a_b[:3, 3], xyz)
    np.testing.assert_array_equal(T_a_b[3], [0, 0, 0, 1])


@given(ROTATION_VECTORS)
def test_a_quaternion_and_its_negative_are_the_same_pose(rotvec):
    q = Rotation.from_rotvec(rotvec).as_quat()

    np.testing.assert_array_equal(pose_matrix([1, 2, 3], q), pose_matrix([1, 2, 3], -q))


def test_the_identity_and_quarter_turns_are_exact():
    np.testing.assert_array_equal(pose_matrix([0, 0, 0], [0, 0, 0, 1]), np.eye(4))
    np.testing.assert_array_equal(
        pose_matrix([0, 0, 0], [1, 0, 0, 0]), np.diag([1.0, -1.0, -1.0, 1.0])
    )


def test_a_quaternion_a_little_off_unit_length_is_normalised():
    q = np.array([0.1, -0.5, 0.3, 0.8])
    q /= np.linalg.norm(q)

    np.testing.assert_allclose(
        pose_matrix([0, 0, 0], 0.9995 * q), pose_matrix([0, 0, 0], q), rtol=0, atol=8 * EPS
    )


@pytest.mark.parametrize('q', [(0, 0, 0.71, 0.71), (0, 0, -0.7035, -0.7072)])
def test_a_quaternion_is_taken_as_tf2_takes_it(q):
    quarter_turn = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(pose_matrix([0, 0, 0], q)[:3, :3], quarter_turn, atol=6e-3)


@pytest.mark.parametrize(
    ('xyz', 'q', 'named'),
    [
        ([0, 0, 0], [0, 0, 0, 0], 'norm 0,'),
        ([0, 0, 0], [0, 0, 0, 0.994], 'norm 0.994'),
        ([0, 0, 0], [0, 0, 0, 1.006], 'norm 1.006'),
        ([0, math.nan, 0], [0, 0, 0, 1], 'finite'),
        ([0, 0], [0, 0, 0, 1], '2 and 4 numbers'),
        ([0, 0, 0], [0, 0, 1], '3 and 3 numbers'),
    ],
)
def test_an_invalid_pose_is_refused_with_what_was_found(xyz, q, named):
    with pytest.raises(ValueError, match=named):
        pose_matrix(xyz, q)


@given(ROTATION_VECTORS)
def test_the_quaternion_of_a_transform_is_that_of_scipy_at_every_angle(rotvec):
    expected = Rotation.from_rotvec(rotvec).as_quat()
    found = q_xyzw(twin_matrix(rotvec, [0, 0, 0]))

    assert found[3] >= 0.0
    aligned = expected * (1.0 if found @ expected > 0.0 else -1.0)
    np.testing.assert_allclose(found, aligned, rtol=0, atol=8 * EPS)


def test_composing_sums_from_left_to_right_without_fusing():
    T_a_b, T_b_c = np.eye(4), np.eye(4)
    T_a_b[0, :3] = [1.0, 1.0, 1.0]
    T_b_c[:3, 3] = [1e16, 1.0, -1e16]
    assert compose(T_a_b, T_b_c)[0, 3] == 0.0  # 1e16 + 1 is 1e16; in another order it is 1

    T_a_b[0, :3], T_b_c[:3, 3] = [1 + EPS, -1.0, 0.0], [1 + EPS, 1 + 2 * EPS, 0.0]
    assert compose(T_a_b, T_b_c)[0, 3] == 0.0  # a fused product would leave EPS squared


@given(TRANSFORMS)
def test_a_transform_and_its_inverse_compose_to_the_identity(T_a_b):
    length = 1.0 + np.abs(T_a_b[:3, 3]).max()

    for product in (compose(T_a_b, inverse(T_a_b)), compose(inverse(T_a_b), T_a_b)):
        np.testing.assert_allclose(product, np.eye(4), rtol=0, atol=16 * EPS * length)


@given(TRANSFORMS, TRANSFORMS)
def test_interpolating_at_the_ends_gives_the_ends_bit_for_bit(T0, T1):
    np.testing.assert_array_equal(interpolate(T0, T1, 0.0), T0)
    np.testing.assert_array_equal(interpolate(T0, T1, 1.0), T1)
    assert interpolate(T0, T1, 0.0) is not T0


@given(ROTATION_VECTORS, ROTATION_VECTORS, st.floats(0.0, 1.0))
def test_interpolating_turns_as_slerp_does(rotvec0, rotvec1, alpha):
    ends = Rotation.from_rotvec([rotvec0, rotvec1])
    if (ends[0].inv() * ends[1]).magnitude() > math.pi - 1e-3:
        return  # half a turn can go either way, and almost half a turn amplifies rounding
    T0, T1 = (pose_matrix([0, 0, 0], q) for q in ends.as_quat())

    found = interpolate(T0, T1, alpha)[:3, :3]

    expected = Slerp([0.0, 1.0], ends)(alpha).as_matrix()
    np.testing.assert_allclose(found, expected, rtol=0, atol=64 * EPS)


@given(VECTORS, VECTORS, st.floats(0.0, 1.0))
def test_interpolating_moves_along_the_straight_line(start, end, alpha):
    T0, T1 = pose_matrix(start, [0, 0, 0, 1]), pose_matrix(end, [0, 0, 0, 1])

    np.testing.assert_allclose(
        interpolate(T0, T1, alpha)[:3, 3],
        (1 - alpha) * start + alpha * end,
        rtol=0,
        atol=2e4 * 4 * EPS,
    )


def test_a_pose_has_the_same_bits_on_every_machine():
    T0 = pose_matrix([10.1, -3.3, 0.7], [0.1, -0.2, 0.3, 0.9274])
    T1 = pose_matrix([11.0, -3.1, 0.9], [0.3, -0.25, 0.1, -0.915])

    T_a_b = compose(interpolate(T0, T1, 0.3), inverse(T1))

    # Written down once, for its bits; the tests above check the values. Only + - * / and sqrt in
    # a fixed order lead here, so a difference means a fused, reordered or approximate operation.
    expected = """
        0x1.68ba9d12cdc74p-1 -0x1.555dc06091002p-1 -0x1.f1cc7a2f36d65p-3 0x1.8b30de5aaa500p-1
        0x1.7094131c03f77p-2 0x1.43080ff551a46p-1 -0x1.5fe5ddb1edc79p-1 -0x1.27fe93c5f14cep+2
        0x1.39239d13045cbp-1 0x1.964508ceb67bap-2 0x1.5e76764e75cd8p-1 -0x1.56a37af0af414p+2
    """
    assert [v.hex() for v in T_a_b[:3].ravel().tolist()] == expected.split()


@pytest.mark.parametrize('alpha', [-1e-9, 1.0 + 1e-9, math.nan])
def test_nothing_is_extrapolated(alpha):
    with pytest.raises(ValueError, match='alpha'):
        interpolate(np.eye(4), np.eye(4), alpha)


@given(ROTATION_VECTORS)
@example(np.array([math.pi, 0.0, 0.0]))
def test_the_angle_is_the_length_of_the_rotation_vector(rotvec):
    angle = rotation_angle(twin_matrix(rotvec, [7, 8, 9]))

    assert angle == pytest.approx(np.linalg.norm(rotvec), abs=16 * EPS)


@given(ROTATION_VECTORS, VECTORS)
def test_the_exponential_is_that_of_the_four_by_four_matrix(phi, rho):
    rho = rho / 1e4
    x, y, z = phi
    generator = np.zeros((4, 4))
    generator[:3] = np.column_stack([[0, z, -y], [-z, 0, x], [y, -x, 0], rho])

    found = se3_exp(np.concatenate([rho, phi]))

    # expm squares a scaled approximation up to a few times: some tens of roundings
    np.testing.assert_allclose(found, expm(generator), rtol=0, atol=64 * EPS)


@given(AXES, ANGLES.filter(lambda angle: angle < math.pi - 1e-9), VECTORS)
def test_the_logarithm_of_the_exponential_is_the_twist(axis, angle, rho):
    xi = np.concatenate([rho, axis * angle])

    found = se3_log(se3_exp(xi))

    np.testing.assert_allclose(found[3:], xi[3:], rtol=0, atol=32 * EPS)
    length = 1.0 + np.linalg.norm(rho)
    np.testing.assert_allclose(found[:3], rho, rtol=0, atol=64 * EPS * length)


@given(AXES, st.sampled_from([1e-15, 1e-12, 1e-9, 1e-6]))
def test_the_logarithm_keeps_all_digits_of_a_tiny_turn(axis, angle):
    xi = np.concatenate([[0.0, 0.0, 0.0], axis * angle])

    np.testing.assert_allclose(se3_log(se3_exp(xi)), xi, rtol=8 * EPS, atol=0)


@pytest.mark.parametrize('xi', [np.zeros(5), np.zeros((6, 1)), np.array([0, 0, 0, 0, 0, np.nan])])
def test_an_invalid_twist_is_refused(xi):
    with pytest.raises(ValueError, match='expected 6 finite numbers'):
        se3_exp(xi)


@pytest.mark.parametrize('number', [0, 1, 50])
def test_normals_of_triangles_are_cross_products_of_their_sides(number):
    corners = np.random.default_rng(number).normal(size=(number, 3, 3))
    sides = corners[:, 1:] - corners[:, :1]
    assert np.array_equal(face_normals(corners), np.cross(sides[:, 0], sides[:, 1]))


def test_quaternions_of_many_rotations_are_those_of_each():
    rng = np.random.default_rng(9)
    turns = [*rng.normal(size=(2000, 3)), *(np.pi * np.eye(3)), *(-np.pi * np.eye(3)), np.zeros(3)]
    turns += [np.pi * axis / np.linalg.norm(axis) for axis in rng.normal(size=(200, 3))]
    poses = np.array([twin_matrix(turn, [1, 2, 3]) for turn in turns])
    np.testing.assert_array_equal(quaternions(poses), [q_xyzw(pose) for pose in poses])
    assert quaternions(np.empty((0, 4, 4))).shape == (0, 4)
