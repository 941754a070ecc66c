# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""LUM against results of pcl::registration::LUM, and against the truth if that fails."""

from __future__ import annotations

from functools import partial
import json

import numpy as np
import pytest

from surfel_mapper.alignment import LUM
from surfel_mapper.alignment.angles import pcl_incidence, transforms
from surfel_mapper.alignment.edge_terms import edge_sums, pcl_terms
from surfel_mapper.errors import AlignmentError

TIGHT = (
    'two_exact',
    'loop3_noisy',
    'loop10_drift',
    'few_corrs',
    'three_corrs',
    'iters_1',
    'iters_5',
    'thr_1e-4',
    'yaw170',
    'both_directions',
    'collinear_axis',
    'first_pose_given',
    'one_vertex',
    'real_pair_outer0',
    'real_pair_outer1',
    'real_pair_outer2',
    'real_pair_outer3',
    'real_loop4',
)

CHAOTIC = ('loop10_drift_fullturn', 'big_rotation')

OTHER = ('disconnected', 'exact_translation', 'near_collinear')


@pytest.fixture(scope='session')
def golden(data_folder):
    with np.load(data_folder / 'golden' / 'lum.npz') as arrays:
        return dict(arrays)


@pytest.fixture(scope='session')
def cases(data_folder):
    return json.loads((data_folder / 'golden' / 'lum.json').read_text())['cases']


def lum_of(golden, cases, name, jacobian):
    case = cases[name]
    lum = LUM(
        jacobian=jacobian,
        max_iterations=case['max_iterations'],
        convergence_threshold=case['convergence_threshold'],
    )
    for v in range(case['n_vertices']):
        given = golden[f'{name}/init_given'][v]
        pose = golden[f'{name}/init_poses'][v] if given else None
        assert lum.add_point_cloud(golden[f'{name}/cloud_{v}'], pose) == v
    for e, (source, target) in enumerate(golden[f'{name}/edges']):
        lum.set_correspondences(source, target, golden[f'{name}/corr_{e}'])
    return lum


def poses(lum):
    return np.array([lum.pose(v) for v in range(lum.num_vertices)])


def as_pcl(terms):
    """Return information and information times motion, about the origin, in PCL's order."""
    num = len(terms.center)
    about_center = np.zeros((num, 6, 6))
    about_center[:] = np.eye(6)
    for e, (x, y, z) in enumerate(terms.center):
        about_center[e, :3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    information = about_center.swapaxes(1, 2) @ terms.information @ about_center
    vector = about_center.swapaxes(1, 2) @ terms.information @ terms.motion[:, :, None]
    order = [0, 1, 2, 3, 5, 4]
    return information[:, order][:, :, order], vector[:, order, 0]


def test_every_golden_case_is_tested(cases):
    assert sorted(cases) == sorted(TIGHT + CHAOTIC + OTHER)
    assert {name for name in cases if cases[name]['compare']['compare'] == 'tight'} == set(TIGHT)


@pytest.mark.parametrize('name', TIGHT)
def test_poses_and_transforms_are_those_of_pcl(golden, cases, name):
    lum, atol = lum_of(golden, cases, name, 'pcl'), cases[name]['compare']['atol']

    if lum.num_vertices > 1:
        lum.compute()

    np.testing.assert_allclose(poses(lum), golden[f'{name}/poses'], rtol=0, atol=atol)
    found = np.array([lum.transformation(v) for v in range(lum.num_vertices)])
    np.testing.assert_allclose(found, golden[f'{name}/transforms'], rtol=0, atol=atol)
    if f'{name}/concat' in golden:
        moved = lum.concatenated_cloud()
        far = np.abs(golden[f'{name}/concat']).max(initial=1.0)
        np.testing.assert_allclose(moved, golden[f'{name}/concat'], rtol=0, atol=atol * far)


@pytest.mark.parametrize('name', [*TIGHT, *CHAOTIC])
def test_poses_after_every_step_are_those_of_pcl(golden, cases, name):
    compare = cases[name]['compare']
    trajectory = golden[f'{name}/trajectory'][: compare.get('trajectory_rows')]
    if cases[name]['n_vertices'] < 2:
        pytest.skip('one vertex takes no steps')

    for k, expected in enumerate(trajectory, start=1):
        lum = lum_of(golden, cases, name, 'pcl')
        lum.max_iterations = k
        lum.compute()
        np.testing.assert_allclose(poses(lum), expected, rtol=0, atol=compare['atol'])


@pytest.mark.parametrize(
    'name',
    [
        'loop3_noisy',
        'loop10_drift',
        'three_corrs',
        'iters_1',
        'both_directions',
        'yaw170',
        'real_loop4',
    ],
)
def test_information_of_edges_is_that_of_pcl(golden, cases, name):
    lum = lum_of(golden, cases, name, 'pcl')
    T, ends = transforms(lum.graph.poses), lum.graph.ends

    T_source, T_target = T[ends[:, 0]], T[ends[:, 1]]
    sums = edge_sums(lum.graph.moments(False), T_source, T_target)
    terms = pcl_terms(sums, partial(lum.graph.residual, T_source, T_target))

    # float32 sums of squares of up to 100 m (real scans), 10 m (others), about the origin
    for found, name_of in zip(as_pcl(terms), ('cinv_first', 'cinvd_first'), strict=True):
        expected = golden[f'{name}/{name_of}']
        largest = np.abs(expected).max(axis=tuple(range(1, expected.ndim)), keepdims=True)
        assert (np.abs(found - expected) / largest).max() < 2e-4


def test_warnings_of_pcl_are_reported(golden, cases):
    lum = lum_of(golden, cases, 'few_corrs', 'pcl')

    result = lum.compute()

    assert set(result.dropped) == {(2, 3), (0, 3)}
    assert result.unconnected == (3,)


def test_one_vertex_is_refused(golden, cases):
    with pytest.raises(AlignmentError, match='vertices: 1, expected two or more'):
        lum_of(golden, cases, 'one_vertex', 'exact').compute()


def test_disconnected_parts_move_as_in_pcl(golden, cases):
    lum, name = lum_of(golden, cases, 'disconnected', 'pcl'), 'disconnected'

    lum.compute()

    compare, expected = cases[name]['compare'], golden[f'{name}/poses']
    held = compare['vertices']
    np.testing.assert_allclose(poses(lum)[held], expected[held], rtol=0, atol=compare['atol'])
    T = golden[f'{name}/transforms'].astype(float)
    np.testing.assert_allclose(
        np.linalg.inv(lum.transformation(3)) @ lum.transformation(4),
        np.linalg.inv(T[3]) @ T[4],
        rtol=0,
        atol=compare['atol'],
    )


def test_pcl_drops_an_exact_edge(golden, cases):
    lum = lum_of(golden, cases, 'exact_translation', 'pcl')

    result = lum.compute()

    assert set(result.dropped) == {(0, 1)}
    np.testing.assert_array_equal(poses(lum), golden['exact_translation/init_poses'])


def test_pairs_near_a_line_move_about_as_in_pcl(golden, cases):
    lum = lum_of(golden, cases, 'near_collinear', 'pcl')

    lum.compute()

    atol = cases['near_collinear']['compare']['atol']
    np.testing.assert_allclose(poses(lum), golden['near_collinear/poses'], rtol=0, atol=atol)


def test_incidence_is_that_of_pcl(golden):
    H = pcl_incidence(golden['incidence/poses'].astype(float))
    order = [0, 1, 2, 3, 5, 4]  # rows of rotation: x, z, y

    np.testing.assert_allclose(H[:, order], golden['incidence/H'], rtol=0, atol=2e-6)


# Errors against the truth that sigma and number of pairs allow, m and entries of R.
WELL_POSED = {
    'two_exact': 1e-6,
    'loop3_noisy': 2e-3,
    'loop10_drift': 1.5e-2,
    'loop10_drift_fullturn': 1.5e-2,
    'three_corrs': 2e-2,
    'iters_5': 5e-3,
    'thr_1e-4': 5e-3,
    'big_rotation': 5e-3,
    'yaw170': 2e-3,
    'both_directions': 2e-2,
    'first_pose_given': 5e-3,
    'exact_translation': 1e-9,
}


@pytest.mark.parametrize('name', WELL_POSED)
def test_exact_steps_reach_the_truth(golden, cases, name):
    lum = lum_of(golden, cases, name, 'exact')
    lum.max_iterations, lum.convergence_threshold = 10, 1e-6

    result = lum.compute()

    assert result.converged
    assert result.iterations <= 6
    found = np.array([lum.transformation(v) for v in range(lum.num_vertices)])
    true = transforms(golden[f'{name}/true_poses'].astype(float))
    np.testing.assert_allclose(found, true, rtol=0, atol=WELL_POSED[name])


def test_parts_without_the_reference_are_reported_and_stay(golden, cases):
    lum = lum_of(golden, cases, 'disconnected', 'exact')

    result = lum.compute()

    assert result.unconnected == (3, 4, 5)
    np.testing.assert_array_equal(poses(lum)[3:], golden['disconnected/init_poses'][3:])


@pytest.mark.parametrize('name', ['collinear_axis', 'near_collinear'])
def test_an_undetermined_rotation_stays_and_is_reported(golden, cases, name):
    lum = lum_of(golden, cases, name, 'exact')

    result = lum.compute()

    assert set(result.open_motions) == {(1, 2)}
    assert result.residuals[1, 2] < 0.03  # sigma is 0.01 m an axis at both ends
    (motion,) = result.open_motions[1, 2]
    np.testing.assert_array_equal(motion[:3], 0.0)
    axis = motion[3:]
    line = lum.transformed_cloud(1)[lum.correspondences(1, 2)[:, 0]]
    along = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    assert abs(axis @ along) > 0.999
    T = lum.transformation(1)[:3, :3].T @ lum.transformation(2)[:3, :3]
    turn = np.array([T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]]) / 2.0
    assert abs(turn @ (lum.transformation(1)[:3, :3].T @ axis)) < 0.02


@pytest.mark.parametrize('name', ['real_pair_outer3', 'real_loop4'])
def test_exact_steps_leave_no_larger_gaps_than_those_of_pcl(golden, cases, name):
    ours, theirs = (lum_of(golden, cases, name, jacobian) for jacobian in ('exact', 'pcl'))
    for lum in (ours, theirs):
        lum.max_iterations = 20

    found, expected = ours.compute(), theirs.compute()

    weigh = sum(np.log(gap) for gap in found.residuals.values())
    assert weigh <= sum(np.log(gap) for gap in expected.residuals.values()) + 1e-6
