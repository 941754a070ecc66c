# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Stripes: the parts of a scan that threads add to a map and subtract at the same time.

The map of one thread is the twin; it is compared with integers of Python elsewhere.
"""

import numpy as np
import pytest

from surfel_mapper.errors import NotInMapError
from surfel_mapper.mapping.moments import LEAST_SHARED, STRIPE_BITS
from surfel_mapper.mapping.surfel_map import SurfelMap
from test.test_threads import in_order

NUM_STRIPES = 2**STRIPE_BITS


def points_at(number, num=60_000, edge_m=16.0):
    """Return points of a scan: most voxels hold one, a third of them those of the scan before."""
    points = np.random.default_rng(number).uniform(0.0, edge_m, (num, 3))
    return points + np.array([0.7 * edge_m * number, 0.0, 0.0])


def stripe_of(key):
    mixed = int(key) * 0x9E3779B97F4A7C15 % 2**64
    mixed = (mixed ^ (mixed >> 32)) * 0xD6E8FEB86659FD93 % 2**64
    return mixed >> (64 - STRIPE_BITS)


def voxels(index):
    return sorted(map(tuple, index.tolist()))


def test_voxels_are_put_in_the_order_of_their_stripes():
    points = points_at(0)
    expected = SurfelMap(0.4).reduce(points, origin=[1.0, 2.0, 3.0])
    moments = SurfelMap(0.4, threads=2).reduce(points, origin=[1.0, 2.0, 3.0])
    stripes = np.array([stripe_of(key) for key in expected.key])
    order = np.argsort(stripes, kind='stable')  # of one stripe as the scan has them
    assert len(order) >= LEAST_SHARED
    for found, values in zip(moments.arrays, expected.arrays, strict=True):
        np.testing.assert_array_equal(found, values[order])
    bounds = np.searchsorted(stripes[order], range(NUM_STRIPES + 1)).tolist()
    assert moments.stripes.tolist() == [
        list(part) for part in zip(bounds[:-1], bounds[1:], range(NUM_STRIPES), strict=True)
    ]
    assert expected.stripes is None


def test_few_voxels_stay_in_the_order_of_the_scan():
    points = points_at(0, num=LEAST_SHARED - 1)
    moments = SurfelMap(0.4, threads=2).reduce(points)
    assert moments.stripes is None
    np.testing.assert_array_equal(moments.key, SurfelMap(0.4).reduce(points).key)


def test_channels_follow_the_order_of_the_voxels():
    points, columns = points_at(0), {'intensity': np.arange(60_000.0)}
    one, two = (SurfelMap(0.4, columns=('intensity',), threads=n) for n in (1, 2))
    for surfel_map in (one, two):
        moments = surfel_map.add(points, columns=columns)
        surfel_map.add(points_at(1), columns=columns)
    assert one == two
    two.remove(moments)
    one.remove(one.reduce(points, columns=columns))
    assert one == two


@pytest.mark.parametrize('threads', [2, 3])
def test_a_window_is_the_same_with_any_number_of_threads(threads):
    one, several = SurfelMap(0.4), SurfelMap(0.4, threads=threads)
    held = []
    for number in range(12):
        points = points_at(number)
        held.append([surfel_map.add(points) for surfel_map in (one, several)])
        if number >= 4:
            fallen = [
                surfel_map.remove(moments, min_points=2)
                for surfel_map, moments in zip((one, several), held[number - 4], strict=True)
            ]
            assert voxels(fallen[0]) == voxels(fallen[1])
            assert len(fallen[0])
        assert several == one
        assert several.num_points == one.num_points
        changed = in_order(several.surfels_changed()), in_order(one.surfels_changed())
        for left, right in zip(*changed, strict=True):
            np.testing.assert_array_equal(left, right)
        keys = one.keys()
        np.testing.assert_array_equal(several.keys_of(several.find(keys)), keys)
    for moments in held[8:]:
        several.remove(moments[1])
    assert several.num_voxels == several.num_points == 0
    assert not len(several.surfels())


def test_rows_that_were_never_used_are_in_no_result():
    surfel_map = SurfelMap(0.4, threads=2)
    first = surfel_map.add(points_at(0))
    second = surfel_map.add(points_at(1, num=3))
    surfel_map.remove(first)
    held = set(surfel_map.find(surfel_map.keys()).tolist())
    assert len(held) == 3
    assert set(surfel_map.rows_changed(-1).tolist()) == {*first.rows.tolist(), *held}
    assert sorted(surfel_map.moments().key) == sorted(second.key)
    assert surfel_map.num_surfels() == len(surfel_map.surfels()) == 3
    index = second.voxel_index
    assert len(surfel_map.coarsen(0, within=(index.min(axis=0), index.max(axis=0)))) == 3


def test_rows_of_voxels_that_left_are_used_again():
    surfel_map = SurfelMap(0.4, threads=2)
    sizes, held = [], []
    for number in range(40):
        held.append(surfel_map.add(points_at(number)))
        if number >= 3:
            surfel_map.remove(held[number - 3])
        sizes.append(surfel_map.nbytes)
    assert sizes[-1] < 1.1 * sizes[5]  # stripes are filled at random


@pytest.mark.parametrize('columns', [(), ('intensity',)])
def test_a_removal_that_one_stripe_refuses_changes_nothing(columns):
    surfel_map = SurfelMap(0.4, threads=2, columns=columns)
    values = {'intensity': np.arange(60_000.0)}
    first = surfel_map.add(points_at(0), columns=values)
    version = surfel_map.version
    surfel_map.add(points_at(1), columns=values)
    wrong = surfel_map.reduce(points_at(0), columns=values)
    at = int(wrong.stripes[3, 0]) + 5
    wrong.total[at, 0] += 1
    wrong.count[at] += 1  # one point more than the voxel holds
    digest, rows = surfel_map.digest(), surfel_map.find(first.key)
    expected = in_order(surfel_map.surfels_changed(since=version))

    index = ' '.join(map(str, wrong.voxel_index[at].tolist())).replace(' ', ', ')
    with pytest.raises(NotInMapError, match=rf'voxel \[{index}\] does not hold'):
        surfel_map.remove(wrong)

    assert surfel_map.digest() == digest
    np.testing.assert_array_equal(surfel_map.find(first.key), rows)
    found = in_order(surfel_map.surfels_changed(since=version))
    kept = np.isin(
        found[-1].view([('', np.int32)] * 3).ravel(), expected[-1].view([('', np.int32)] * 3)
    )
    for left, right in zip(found, expected, strict=True):
        np.testing.assert_array_equal(left[kept], right)
    surfel_map.remove(first)
    alone = SurfelMap(0.4, columns=columns)
    alone.add(points_at(1), columns=values)
    assert surfel_map == alone


def test_a_map_of_several_threads_takes_moments_in_any_order():
    one, two = SurfelMap(0.4), SurfelMap(0.4, threads=2)
    moments = one.reduce(points_at(0))
    one.insert(moments)
    two.insert(moments)
    in_stripes = two.reduce(points_at(1))
    one.insert(in_stripes)
    two.insert(in_stripes)
    two.merge(one)
    two.subtract(one)
    assert two == one
    one.remove(in_stripes)
    two.remove(moments)
    assert two.moments().key.tolist() == sorted(in_stripes.key.tolist())
    assert one.moments().key.tolist() == sorted(moments.key.tolist())
