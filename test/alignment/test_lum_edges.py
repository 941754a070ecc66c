# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""LUM: refused input, undetermined edges, and barely solvable graphs."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.alignment import Graph, LUM
from surfel_mapper.errors import AlignmentError
from test.alignment.scan_graphs import make, random_transforms


@pytest.fixture
def pair():
    lum = LUM()
    for _ in range(2):
        lum.add_point_cloud(np.eye(3))
    lum.set_correspondences(0, 1, [[0, 0], [1, 1], [2, 2]])
    return lum


@pytest.mark.parametrize(
    ('refused', 'message'),
    [
        (lambda lum: lum.add_point_cloud(np.empty((0, 3))), 'vertex 2: no points'),
        (lambda lum: lum.add_point_cloud([1.0, 2.0]), r'vertex 2: points of shape \(2,\)'),
        (lambda lum: lum.add_point_cloud(np.eye(3), [0.0] * 5), 'vertex 2: pose'),
        (lambda lum: lum.set_pose(0, [0.0] * 6), 'vertex 0 is the reference'),
        (lambda lum: lum.set_pose(2, [0.0] * 6), 'no vertex 2 among 2'),
        (lambda lum: lum.pose(-1), 'no vertex -1 among 2'),
        (lambda lum: lum.set_correspondences(0, 5, [[0, 0]]), 'no vertex 5'),
        (lambda lum: lum.set_correspondences(1, 1, [[0, 0]]), 'edge 1 -> 1: from a vertex to'),
        (lambda lum: lum.set_correspondences(0, 1, [[0, 3]]), 'names point 3 of vertex 1'),
        (lambda lum: lum.set_correspondences(0, 1, [[0.5, 1]]), 'integers'),
        (lambda lum: lum.set_correspondences(0, 1, [0, 1, 2]), r'pairs of shape \(3,\)'),
        (lambda lum: lum.set_correspondences(0, 1, [[0, 0]], np.eye(3)), 'weights of shape'),
        (
            lambda lum: lum.set_correspondences(0, 1, [[0, 0]], [np.full((3, 3), np.nan)]),
            'all finite',
        ),
        (lambda lum: lum.correspondences(1, 0), 'no edge 1 -> 0'),
        (lambda lum: lum.set_point_cloud(1, np.eye(3)[:2]), 'names point 2 of vertex 1'),
        (lambda lum: (setattr(lum, 'max_iterations', 0), lum.compute()), 'max_iterations 0'),
        (lambda _: LUM(max_iterations=True), 'max_iterations True, expected an integer'),
        (
            lambda lum: lum.set_correspondences(0, 1, [[0, 0]], [np.eye(3) + np.eye(3, k=1)]),
            'edge 0 -> 1: weight 0 is not symmetric',
        ),
        (
            lambda lum: lum.set_correspondences(
                0, 1, [[0, 0], [1, 1]], [np.eye(3), np.diag([1.0, -0.1, 1.0])]
            ),
            'edge 0 -> 1: weight 1 has a negative eigenvalue',
        ),
        (
            lambda lum: lum.set_correspondences(
                0, 1, [[0, 0]], [[[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]
            ),
            'weight 0 has a negative eigenvalue',
        ),
        (lambda _: LUM(jacobian='numeric'), "jacobian 'numeric'"),
        (lambda _: LUM().compute(), 'vertices: 0'),
    ],
)
def test_bad_input_is_refused_and_changes_nothing(pair, refused, message):
    with pytest.raises(AlignmentError, match=message):
        refused(pair)

    assert pair.num_vertices == 2
    np.testing.assert_array_equal(pair.correspondences(0, 1), [[0, 0], [1, 1], [2, 2]])
    np.testing.assert_array_equal(pair.point_cloud(1), np.eye(3))
    np.testing.assert_array_equal(pair.pose(1), np.zeros(6))


def test_pairs_in_one_point_are_dropped(pair):
    pair.set_correspondences(0, 1, [[0, 0]] * 5)

    result = pair.compute()

    assert result.dropped == {(0, 1): 'all its pairs lie in one point'}
    assert result.unconnected == (1,)


def test_dropped_edges_have_no_open_motions(pair):
    pair.set_correspondences(0, 1, [[0, 0], [1, 1]])

    result = pair.compute()

    assert set(result.dropped) == {(0, 1)}
    assert not result.open_motions


def test_edges_of_zero_weights_are_dropped(pair):
    pair.set_correspondences(0, 1, [[0, 0], [1, 1], [2, 2]], np.zeros((3, 3, 3)))

    assert pair.compute().dropped == {(0, 1): 'all its weights are zero'}


def test_the_steps_of_pcl_refuse_weights(pair):
    pair.jacobian = 'pcl'
    pair.set_correspondences(0, 1, [[0, 0]] * 3, [np.eye(3)] * 3)

    with pytest.raises(AlignmentError, match='weights'):
        pair.compute()


def test_the_steps_of_pcl_are_refused_where_they_are_singular():
    rng = np.random.default_rng(16)
    lum = make(rng, random_transforms(rng, 2, 0.3), [(0, 1)], jacobian='pcl')
    lum.set_pose(1, [0.0, 0.0, 0.0, 0.0, np.pi / 2, 0.0])
    before = lum.pose(1)

    try:
        lum.compute()
    except AlignmentError:
        np.testing.assert_array_equal(lum.pose(1), before)


def test_a_first_pose_is_ignored_with_a_warning(caplog):
    lum = LUM()

    lum.add_point_cloud(np.eye(3), [1.0] * 6)

    np.testing.assert_array_equal(lum.pose(0), np.zeros(6))
    assert 'vertex 0' in caplog.text


def test_an_empty_graph_has_no_edges():
    graph = Graph()

    assert graph.ends.shape == (0, 2)
    assert graph.poses.shape == (0, 6)
