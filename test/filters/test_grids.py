# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""VoxelGrid and OctreeGrid against the golden values of libpointmatcher and slow twins."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from surfel_mapper.errors import ConfigError, FilterError
from surfel_mapper.filters.chain import Chain
from surfel_mapper.filters.grids import leaves
from test.filters.examples import filter_of, random_scan, scan_of

GOLDEN = Path(os.environ.get('SURFEL_MAPPER_TEST_DATA', '')) / 'golden'
LIBPOINTMATCHER = 'VoxelGridDataPointsFilter'


def golden_cases():
    if not os.environ.get('SURFEL_MAPPER_TEST_DATA'):
        return {}
    return json.loads((GOLDEN / 'voxel_grid.json').read_text())['cases']


CASES = golden_cases()

needs_golden = pytest.mark.skipif(not CASES, reason='SURFEL_MAPPER_TEST_DATA is not set')


def names(status=0, centroid=True):
    return [
        name
        for name, case in CASES.items()
        if case['status'] == status
        and (status or (case['params'].get('useCentroid') != '0') == centroid)
    ]


@pytest.fixture(scope='module')
def arrays():
    with np.load(GOLDEN / 'voxel_grid.npz') as content:
        return dict(content)


def split(values, labels):
    """Return the descriptors in a matrix by name, (N,) or (N, C)."""
    ends = np.cumsum([rows for _, rows in labels])
    parts = np.split(values, ends[:-1], axis=1) if len(ends) else []
    return {
        name: part[:, 0] if rows == 1 else part
        for (name, rows), part in zip(labels, parts, strict=True)
    }


def scan_in(case, arrays):
    xyz = arrays[case['xyz_key']]
    points = np.zeros((len(xyz), 3), xyz.dtype)
    points[:, : case['dim']] = xyz  # a 2-D cloud is one layer
    columns = {}
    if case['descriptor_labels']:
        columns = split(arrays[case['desc_key']], case['descriptor_labels'])
    if case['has_times']:
        columns['times'] = arrays[case['times_key']][:, 0]
    return scan_of(points, **columns)


def filtered(case, arrays):
    return Chain.from_list([{LIBPOINTMATCHER: case['params']}]).apply(scan_in(case, arrays))


@needs_golden
@pytest.mark.parametrize('name', [n for n in names() if not n.startswith('real')])
def test_centroids_columns_and_order_equal_libpointmatcher(name, arrays):
    case = CASES[name]
    found = filtered(case, arrays)
    expected = arrays[f'out/{name}/features'][:, : case['dim']]
    assert len(found) == case['n_out'] == case['n_out_f64_arithmetic']
    # float32 sums of libpointmatcher are off by the tolerance of the case; each rounds once
    tolerance = case['max_abs_centroid_diff_vs_f64'] + np.spacing(np.float32(abs(expected).max()))
    np.testing.assert_allclose(found.points[:, : case['dim']], expected, rtol=0.0, atol=tolerance)
    descriptors = split(arrays[f'out/{name}/descriptors'], case['descriptor_labels'])
    for column, values in descriptors.items():
        np.testing.assert_allclose(found.columns[column], values, rtol=2e-6, atol=1e-6)
    if case['has_times']:
        np.testing.assert_array_equal(found.columns['times'], arrays[f'out/{name}/times'][:, 0])


@needs_golden
@pytest.mark.parametrize('name', [n for n in names() if n.startswith('real')])
def test_centroids_of_a_real_scan_equal_libpointmatcher_except_at_faces(name, arrays):
    case = CASES[name]
    found = filtered(case, arrays).points.astype(np.float64)
    expected = arrays[f'out/{name}/features'][:, :3].astype(np.float64)
    assert len(found) == len(expected) == case['n_out']
    for these, those in ((found, expected), (expected, found)):
        distances, _ = cKDTree(those).query(these)
        # in float32 one of the 69,792 points is on the other side of a face: two centroids move
        assert np.count_nonzero(distances > 2e-5) <= 2


@needs_golden
@pytest.mark.parametrize('name', names(centroid=False))
def test_centres_are_those_of_libpointmatchers_voxels(name, arrays):
    case = CASES[name]
    scan, found = scan_in(case, arrays), filtered(case, arrays)
    assert len(found) == case['n_out']
    size = [float(case['params'].get(f'vSize{axis}', 1.0)) for axis in 'XYZ']
    centres = slow(scan, size, 'minimum', centroid=False)
    tolerance = 2 * np.spacing(abs(centres).max().astype(scan.points.dtype))
    np.testing.assert_allclose(found.points, centres, rtol=0.0, atol=tolerance)


@needs_golden
@pytest.mark.parametrize('name', names(status=1))
def test_cases_that_libpointmatcher_refuses_are_refused_but_for_nan(name, arrays):
    if name.startswith('nan'):  # libpointmatcher refuses a scan for a nan, ours drops the point
        finite = np.isfinite(arrays[CASES[name]['xyz_key']]).all(axis=1)
        assert (len(filtered(CASES[name], arrays)) == 0) == (not finite.any())
        return
    with pytest.raises(ConfigError):
        filtered(CASES[name], arrays)


def slow(scan, size, anchor, centroid=True):
    """Return the points that voxels leave, in a dictionary and in float64."""
    points, size = scan.points.astype(np.float64), np.array(size)
    shift = points.min(axis=0) / size if anchor == 'minimum' else np.zeros(3)
    voxels = {}
    for point in points:
        voxels.setdefault(tuple(np.floor(point / size - shift)), []).append(point)
    if centroid:
        return np.array([np.sum(each, axis=0) / len(each) for each in voxels.values()])
    return (np.array(list(voxels)) + 0.5 + shift) * size


def test_columns_of_the_first_point_are_kept_without_averaging():
    scan = scan_of([[0.1, 0.0, 0.0], [0.3, 0.0, 0.0]], intensity=[1.0, 3.0], label=[4, 5])
    averaged = filter_of('voxel_grid').apply(scan).columns
    first = filter_of('voxel_grid', average_columns=False).apply(scan).columns
    assert (averaged['intensity'].tolist(), averaged['label'].tolist()) == ([2.0], [4])
    assert (first['intensity'].tolist(), first['label'].tolist()) == ([1.0], [4])


def test_averaged_normals_have_unit_length_but_under_libpointmatchers_name():
    normals = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    scan = scan_of([[0.1, 0.0, 0.0], [0.3, 0.0, 0.0]], normals=normals)
    ours = filter_of('voxel_grid').apply(scan).columns['normals']
    theirs = filter_of(LIBPOINTMATCHER).apply(scan).columns['normals']
    np.testing.assert_allclose(ours, [[0.5**0.5, 0.0, 0.5**0.5]], rtol=1e-15)
    np.testing.assert_allclose(theirs, [[0.5, 0.0, 0.5]])


def test_memory_follows_the_points_and_not_the_extent():
    # a dense grid of these has 2^57 voxels, and libpointmatcher's wraps at 2^32
    scan = scan_of([[0.0, 0.0, 0.0], [5e5, 5e5, 5e5], [-5e5, -5e5, -5e5], [0.1, 0.1, 0.1]])
    sizes = dict.fromkeys(('size_x_m', 'size_y_m', 'size_z_m'), 1.0)
    assert len(filter_of('voxel_grid', **sizes).apply(scan)) == 3


@pytest.mark.parametrize(('far', 'size'), [(5e9, 1.0), (3e6, 1e-3 * 1.0), (1e30, 1.0)])
def test_an_extent_that_no_key_can_number_is_refused_with_what_to_do(far, size):
    scan = scan_of([[0.0, 0.0, 0.0], [far, far, far]])
    sizes = dict.fromkeys(('size_x_m', 'size_y_m', 'size_z_m'), size)
    with pytest.raises(FilterError, match=r'extends over .* voxels, .*use larger ones'):
        filter_of('voxel_grid', **sizes).apply(scan)


def test_voxels_of_too_few_points_are_dropped():
    points = [[0.1, 0, 0], [5.1, 0, 0], [0.2, 0, 0], [9.1, 0, 0], [9.2, 0, 0], [9.3, 0, 0]]
    scan = scan_of(points, value=np.arange(6.0))
    sizes = []
    for least in (1, 2, 3, 4):
        found = filter_of('voxel_grid', min_points=least).apply(scan)
        sizes.append(len(found))
        assert len(found.columns['value']) == len(found)
    assert sizes == [3, 2, 1, 0]


def test_a_voxel_may_be_infinite_but_has_no_centre_then():
    scan = random_scan(50)
    found = filter_of('voxel_grid', size_x_m=np.inf, size_y_m='inf', size_z_m='.inf').apply(scan)
    np.testing.assert_allclose(found.points, [scan.points.mean(axis=0)], rtol=0.0, atol=1e-5)
    with pytest.raises(ConfigError, match='has no centre'):
        filter_of('voxel_grid', size_x_m=np.inf, use_centroid=False)


OCTREE = 'OctreeGridDataPointsFilter'


def slow_leaves(points, max_points, max_size):
    """Return the leaves as sets of rows, by cutting cubes one after another."""
    low, high = points.min(axis=0), points.max(axis=0)
    edge = (high - low).max()
    corner = 0.5 * (low + high) - 0.5 * edge
    corner[low == high] = low[low == high]
    open_, found = [(corner, edge, np.arange(len(points)))], []
    while open_:
        corner, edge, rows = open_.pop()
        if len(rows) <= max_points or edge <= max_size:
            found.append(frozenset(rows.tolist()))
            continue
        upper = points[rows] >= corner + 0.5 * edge
        for which in np.unique(upper, axis=0):
            inside = rows[(upper == which).all(axis=1)]
            open_.append((corner + 0.5 * edge * which, 0.5 * edge, inside))
    return set(found)


@pytest.mark.parametrize(
    ('max_points', 'max_size'), [(1, 0.0), (5, 0.0), (1, 0.3), (40, 0.6), (1, 9.0), (1000, 0.0)]
)
@pytest.mark.parametrize('flat', [False, True])
def test_leaves_are_those_of_a_tree(max_points, max_size, flat):
    points = np.random.default_rng(1).uniform(-2.0, 2.0, (600, 3))
    points[:, 2] *= 0.0 if flat else 0.2
    rows, number = leaves(points, max_points, max_size)
    found = {frozenset(np.flatnonzero(rows == leaf).tolist()) for leaf in range(number)}
    assert found == slow_leaves(points, max_points, max_size)
    _, first = np.unique(rows, return_index=True)
    assert (np.diff(first) > 0).all()  # numbered as they first appear


SQUARE = [[0.0, 0, 0], [0.2, 0, 0], [0.1, 0.25, 0], [4.0, 4.0, 0], [0.1, 0.1, 0], [0.0, 4.0, 0]]
"""Four points in the lowest cube of an edge of 1, and two alone."""


def sampled(method, **columns):
    scan = scan_of(SQUARE, row=range(6), **columns)
    return filter_of(OCTREE, maxSizeByNode=1.0, samplingMethod=method).apply(scan)


def test_the_first_point_stands_for_its_leaf():
    assert sampled(0).columns['row'].tolist() == [0, 3, 5]


def test_a_random_point_stands_for_its_leaf_and_any_may():
    found = {
        filter_of(OCTREE, maxSizeByNode=1.0, samplingMethod=1, seed=seed)
        .apply(scan_of(SQUARE, row=range(6)))
        .columns['row'][0]
        for seed in range(60)
    }
    assert found == {0, 1, 2, 4}


def test_the_mean_stands_for_its_leaf_with_averaged_columns():
    found = sampled(2, intensity=[1.0, 2.0, 3.0, 9.0, 6.0, 7.0], label=[5, 6, 7, 8, 9, 10])
    np.testing.assert_allclose(found.points, [[0.1, 0.0875, 0], [4.0, 4.0, 0], [0.0, 4.0, 0]])
    assert found.columns['intensity'].tolist() == [3.0, 9.0, 7.0]
    assert found.columns['label'].tolist() == [5, 8, 10]


def test_the_point_nearest_the_mean_stands_for_its_leaf():
    assert sampled(3).columns['row'].tolist() == [4, 3, 5]


def test_by_default_every_place_keeps_one_point():
    scan = random_scan(200)
    twice = scan.select(np.concatenate([np.arange(200), np.arange(200)]))
    found = filter_of(OCTREE).apply(twice)
    np.testing.assert_array_equal(found.points, scan.points)


@pytest.mark.parametrize('method', range(4))
def test_points_nearer_than_paths_can_tell_stay_together(method):
    near = np.nextafter(np.float64(1.0), 2.0)
    scan = scan_of([[1.0, 0, 0], [near, 0, 0], [-1.0, 0, 0]])
    assert len(filter_of(OCTREE, samplingMethod=method).apply(scan)) == 2
