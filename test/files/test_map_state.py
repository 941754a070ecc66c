# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A saved map comes back with its window exactly, or is refused."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import WindowConfig
from surfel_mapper.errors import FileFormatError, NotInMapError
from surfel_mapper.files.map_state import check_held, load_map, save_map
from surfel_mapper.files.state import load_state, save_state
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow, WindowedScan


def driven(num_scans=6, *, keep_points=False):
    """Return a map and its window of three scans after a drive."""
    rng = np.random.default_rng(3)
    surfel_map = SurfelMap(0.5)
    window = SlidingWindow(surfel_map, WindowConfig(max_scans=3, keep_points=keep_points))
    for number in range(num_scans):
        pose = np.eye(4)
        pose[:3, 3] = number, 0.1, 0.2
        points = rng.uniform(-4.0, 4.0, (500, 3)).astype(np.float32)
        window.insert(
            WindowedScan(
                moments=surfel_map.reduce(points, pose, origin=pose[:3, 3]),
                stamp_ns=number * 10**8,
                T_map_sensor=pose,
                points=points if keep_points else None,
                frame_id=('front', 'rear')[number % 2],
            )
        )
    return surfel_map, window


@pytest.mark.parametrize('keep_points', [False, True])
def test_a_map_comes_back_with_its_digest_and_its_window(tmp_path, keep_points):
    surfel_map, window = driven(keep_points=keep_points)

    digest = save_map(tmp_path / 'map.npz', surfel_map, window)
    loaded, scans = load_map(tmp_path / 'map.npz', voxel_size_m=0.5)

    assert digest == surfel_map.digest() == loaded.digest()
    assert [scan.stamp_ns for scan in scans] == [scan.stamp_ns for scan in window]
    assert [scan.frame_id for scan in scans] == ['rear', 'front', 'rear']
    for scan, kept in zip(scans, window, strict=True):
        np.testing.assert_array_equal(scan.T_map_sensor, kept.T_map_sensor)
        assert (scan.points is None) == (kept.points is None)
        if keep_points:
            np.testing.assert_array_equal(scan.points, kept.points)


def test_a_loaded_map_continues_like_the_saved_one(tmp_path):
    surfel_map, window = driven()
    save_map(tmp_path / 'map.npz', surfel_map, window)
    loaded, scans = load_map(tmp_path / 'map.npz')
    resumed = SlidingWindow(loaded, window.config)
    resumed.restore(scans)

    new = WindowedScan(
        moments=surfel_map.reduce(np.ones((9, 3))), stamp_ns=10**10, T_map_sensor=np.eye(4)
    )
    window.insert(new)
    resumed.insert(new)

    assert len(resumed) == len(window) == 3
    assert loaded == surfel_map


@pytest.mark.parametrize('frame_ids', [5, 'abc', ['front', 'rear'], ['front', 'rear', 5], None])
def test_frames_that_are_not_those_of_the_scans_are_refused(tmp_path, frame_ids):
    save_map(tmp_path / 'map.npz', *driven())
    arrays, attributes = load_state(tmp_path / 'map.npz')
    save_state(tmp_path / 'map.npz', arrays, {**attributes, 'frame_ids': frame_ids})
    with pytest.raises(FileFormatError, match=r'damaged, .*frames'):
        load_map(tmp_path / 'map.npz')


def test_an_empty_map_comes_back(tmp_path):
    save_map(tmp_path / 'map.npz', SurfelMap(0.25))
    loaded, scans = load_map(tmp_path / 'map.npz')
    assert (loaded.num_voxels, loaded.voxel_size_m, scans) == (0, 0.25, [])


def test_a_coarser_level_comes_back(tmp_path):
    coarse = driven()[0].coarsen(2)
    save_map(tmp_path / 'map.npz', coarse)
    assert load_map(tmp_path / 'map.npz')[0] == coarse


def test_another_voxel_size_is_refused(tmp_path):
    save_map(tmp_path / 'map.npz', driven()[0])
    with pytest.raises(FileFormatError, match=r'0\.5 m, expected map\.voxel_size_m = 0\.2'):
        load_map(tmp_path / 'map.npz', voxel_size_m=0.2)


def test_a_file_of_another_kind_is_refused(tmp_path):
    save_state(tmp_path / 'map.npz', {}, {'kind': 'mesh'})
    with pytest.raises(FileFormatError, match="contains 'mesh', expected a surfel map"):
        load_map(tmp_path / 'map.npz')


@pytest.mark.parametrize(
    ('name', 'change'),
    [
        ('map.key', lambda keys: np.repeat(keys[:1], len(keys))),
        ('map.count', lambda counts: 0 * counts),
        ('scan1.count', np.negative),
        ('map.total', lambda totals: totals + 10**15),
        ('map.product', lambda products: products[:, :5].copy()),
        ('map.total', lambda totals: totals.astype(np.float64)),
        ('digest', lambda _: '0' * 64),
        ('scan0.view', None),
        ('scan0.key', lambda keys: np.arange(len(keys))),  # voxels that the map does not have
        ('scans.pose', lambda poses: np.nan * poses),
        ('voxel_size_m', lambda _: 'large'),
    ],
)
def test_contents_that_no_map_can_have_are_refused(tmp_path, name, change):
    """The hash of a file proves that it is unchanged, not that its content is a possible map."""
    save_map(tmp_path / 'map.npz', *driven())
    arrays, attributes = load_state(tmp_path / 'map.npz')
    changed = arrays if name in arrays else attributes
    value = changed.pop(name)
    if change:
        changed[name] = change(value)
    save_state(tmp_path / 'map.npz', arrays, attributes)

    with pytest.raises(FileFormatError, match='damaged'):
        load_map(tmp_path / 'map.npz')


@pytest.mark.parametrize(
    'points',
    [[0.1, 0.2, 0.3, 0.4], [0.1, 0.2, 0.31], [0.1, 0.2, 0.9]],
    ids=['more points', 'another sum', 'another voxel'],
)
def test_a_window_of_points_that_the_map_does_not_hold_is_refused(points):
    surfel_map, held, other = (SurfelMap(0.5) for _ in range(3))
    surfel_map.add(np.outer([0.1, 0.2, 0.3], np.ones(3)))
    for number in range(4):
        held.clear()
        held.add(np.outer([0.1, 0.2, 0.3][:number], np.ones(3)).reshape(-1, 3))
        check_held(surfel_map.moments(), held.moments())

    other.add(np.outer(points, np.ones(3)))
    with pytest.raises(NotInMapError, match='does not hold the points of its window'):
        check_held(surfel_map.moments(), other.moments())
    with pytest.raises(NotInMapError):
        check_held(SurfelMap(0.5).moments(), other.moments())


def test_numbers_of_scans_come_back_and_leave_with_the_window(tmp_path):
    surfel_map, window = driven()
    save_map(tmp_path / 'map.npz', surfel_map, window)

    loaded, scans = load_map(tmp_path / 'map.npz')

    expected = surfel_map.moments().num_scans
    np.testing.assert_array_equal(loaded.moments().num_scans, expected)
    for scan in scans[:2]:
        loaded.remove(scan.moments)
    assert loaded.num_voxels
    assert (loaded.moments().num_scans == 1).all()


def test_a_map_without_numbers_of_scans_is_refused(tmp_path):
    save_map(tmp_path / 'map.npz', *driven())
    arrays, attributes = load_state(tmp_path / 'map.npz')
    del arrays['map.num_scans']
    save_state(tmp_path / 'map.npz', arrays, attributes)

    with pytest.raises(FileFormatError, match='num_scans'):
        load_map(tmp_path / 'map.npz')


@pytest.mark.parametrize('wrong', [0, 10**6])
def test_impossible_numbers_of_scans_in_a_file_are_refused(tmp_path, wrong):
    save_map(tmp_path / 'map.npz', *driven())
    arrays, attributes = load_state(tmp_path / 'map.npz')
    numbers = arrays['map.num_scans'].copy()
    numbers[3] = wrong
    save_state(tmp_path / 'map.npz', {**arrays, 'map.num_scans': numbers}, attributes)

    with pytest.raises(FileFormatError, match='impossible numbers of scans'):
        load_map(tmp_path / 'map.npz')
