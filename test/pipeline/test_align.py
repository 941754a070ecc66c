# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Mapper.align: scans move in the map exactly, filtered, deskewed or cleared before."""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np
import pytest

from surfel_mapper.config import Config, WindowConfig
from surfel_mapper.errors import AlignmentError
from surfel_mapper.geometry import q_xyzw
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow, WindowedScan
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.window_aligner import WindowAligner
from test.alignment.street import drifted, street_scans
from test.fields import config_of

NUM_SCANS = 8

SETTINGS = {
    'pose.source': 'odometry',
    'window.keep_points': True,
    'align.key_distance_m': 0.0,
    'frames.base': 'lidar',
}


@pytest.fixture(scope='module')
def drive():
    scans, true = street_scans(30)
    return scans[:NUM_SCANS], true[:NUM_SCANS], drifted(true[:NUM_SCANS], 0.02, 0.2)


def mapped(drive, settings=(), number=NUM_SCANS):
    """Return a mapper that has mapped scans where drifting odometry has them."""
    mapper = Mapper(config_of({**SETTINGS, **dict(settings)}))
    return mapper, feed(mapper, drive, range(number))


def feed(mapper, drive, numbers):
    scans, _, poses = drive
    updates = []
    for number in numbers:
        scan, pose = scans[number], poses[number]
        mapper.add_pose('odom', 'lidar', scan.stamp_ns, pose[:3, 3], q_xyzw(pose))
        mapper.add_scan(scan)
        updates += mapper.insert_ready()
    return updates


def rebuilt(mapper, reduced):
    """Return the map of scans at the poses that they have in the window now."""
    limits = mapper.config.input
    surfel_map = SurfelMap(mapper.config.map.voxel_size_m, columns=mapper.map.columns)
    for scan, windowed in zip(reduced, mapper.window, strict=True):
        pose = windowed.T_map_sensor
        moments = surfel_map.reduce(
            scan.points,
            pose,
            origin=pose[:3, 3],
            columns=scan.columns,
            min_range_m=limits.min_range_m,
            max_range_m=limits.max_range_m or math.inf,
        )
        surfel_map.insert(moments)
    return surfel_map


def test_the_map_equals_one_built_at_the_corrected_poses(drive):
    mapper, _ = mapped(drive)
    before = mapper.map.digest()

    aligned = mapper.align()

    assert aligned.num_moved > 0
    assert mapper.map.digest() != before
    assert mapper.map.digest() == rebuilt(mapper, drive[0]).digest()
    np.testing.assert_array_equal(
        aligned.T_map_sensor, [scan.T_map_sensor for scan in mapper.window]
    )


def test_scans_of_another_sensor_are_no_key_scans_for_its_place():
    # both sensors stand still: of their ten scans the first of each is one, and the last
    rng = np.random.default_rng(1)
    places = np.repeat(rng.integers(-8, 8, (40, 3)) + 0.5, 12, axis=0)
    points = places + rng.normal(scale=[0.1, 0.1, 0.001], size=places.shape)
    surfel_map = SurfelMap(0.5)
    window = SlidingWindow(surfel_map, WindowConfig(keep_points=True))
    for number in range(10):
        pose = np.eye(4)
        pose[0, 3] = 2.0 * (number % 2)
        seen = points - pose[:3, 3]
        moments = surfel_map.reduce(seen, pose, origin=pose[:3, 3])
        frame = ('front', 'rear')[number % 2]
        window.insert(
            WindowedScan(
                moments=moments, stamp_ns=number, T_map_sensor=pose, points=seen, frame_id=frame
            )
        )
    aligner = WindowAligner(lambda scan, pose: surfel_map.reduce(scan.points, pose))

    aligned = aligner.align(window, Config())

    assert set(aligned.solution.residuals) == {(1, 0), (9, 1), (9, 0)}


@pytest.mark.parametrize(
    ('far_m', 'settings'),
    [
        (np.finfo(np.float32).max, {}),  # as drivers mark no return
        (2e5, {'align.voxel_size_m': 0.1}),  # in the map, but beyond the voxels of the alignment
    ],
)
def test_points_out_of_reach_leave_no_scan_unaligned(drive, far_m, settings):
    far = np.full((50, 3), far_m, np.float32)
    scans = [
        replace(scan, points=np.concatenate([far, scan.points]), columns={}) for scan in drive[0]
    ]
    mapper, _ = mapped((scans, *drive[1:]), settings)

    assert mapper.align().num_moved > 0

    assert mapper.map.digest() == rebuilt(mapper, scans).digest()
    assert [len(scan.points) for scan in mapper.window] == [
        scan.moments.num_points for scan in mapper.window
    ]


def test_colours_named_rgba_stay_with_their_points(drive):
    rng = np.random.default_rng(1)
    colours = [rng.integers(0, 2**32, len(scan), np.uint32) for scan in drive[0]]
    scans = [
        replace(scan, columns={'rgba': rgba}) for scan, rgba in zip(drive[0], colours, strict=True)
    ]
    mapper, _ = mapped((scans, *drive[1:]), {'map.color': True})

    assert mapper.align().num_moved > 0

    opaque = [
        replace(scan, columns={'rgb': rgba & 0xFFFFFF})
        for scan, rgba in zip(drive[0], colours, strict=True)
    ]
    assert mapper.map.digest() == rebuilt(mapper, opaque).digest()


def test_filtered_points_stay_out_after_an_alignment(drive, tmp_path):
    chain = tmp_path / 'chain.yaml'
    chain.write_text('- RandomSamplingDataPointsFilter:\n    prob: 0.5\n')
    mapper, _ = mapped(drive, {'filters': str(chain)})
    kept = [
        replace(scan, points=windowed.points, columns={})
        for scan, windowed in zip(drive[0], mapper.window, strict=True)
    ]
    num_points = mapper.map.num_points

    assert mapper.align().num_moved > 0
    assert mapper.map.num_points == num_points
    assert mapper.map.digest() == rebuilt(mapper, kept).digest()


def test_the_window_is_aligned_every_few_scans(drive):
    mapper, updates = mapped(drive, {'align.every_scans': 3})

    assert [update.alignment is not None for update in updates] == [False, False, True] * 2 + [
        False,
        False,
    ]
    due = updates[5]
    np.testing.assert_array_equal(due.T_map_sensor, due.alignment.T_map_sensor[-1])
    assert len(due.alignment.stamps_ns) == 6
    assert mapper.map.digest() == rebuilt(mapper, drive[0]).digest()
    assert 'align' in mapper.counters.milliseconds


def test_changes_and_removals_of_an_update_cover_the_alignment(drive):
    settings = {'align.every_scans': NUM_SCANS, 'map.min_points': 5}
    mapper, _ = mapped(drive, settings, number=NUM_SCANS - 1)
    known = {tuple(i) for i in mapper.map.surfels(5).voxel_index.tolist()}

    update = feed(mapper, drive, [NUM_SCANS - 1])[-1]

    assert update.alignment is not None
    known |= {tuple(i) for i in update.changed.voxel_index.tolist()}
    known -= {tuple(i) for i in update.removed_voxel_index.tolist()}
    assert known == {tuple(i) for i in mapper.map.surfels(5).voxel_index.tolist()}


def test_clearing_forgets_the_correction(drive):
    mapper, _ = mapped(drive, number=6)
    mapper.align()
    mapper.clear()

    update = feed(mapper, drive, [6])[-1]

    np.testing.assert_allclose(update.T_map_sensor, drive[2][6], rtol=0, atol=1e-12)


def test_the_map_has_the_frame_that_it_is_given(drive):
    _, updates = mapped(drive, {'align.map_frame': 'map'}, number=1)

    assert updates[0].frame_id == 'map'
    assert mapped(drive, number=1)[1][0].frame_id == 'odom'


def test_windows_without_points_are_refused_and_stay(drive):
    mapper, _ = mapped(drive, {'window.keep_points': False}, number=3)
    before = mapper.map.digest()

    with pytest.raises(AlignmentError, match=r'0 of 3 scans .* window.keep_points'):
        mapper.align()

    assert mapper.map.digest() == before


@pytest.mark.parametrize('number', [0, 1])
def test_fewer_than_two_scans_are_refused(drive, number):
    with pytest.raises(AlignmentError, match=f'^{number} scans? in the map'):
        mapped(drive, number=number)[0].align()


def test_frames_are_found_in_the_map_as_it_was_corrected(drive):
    mapper, _ = mapped(drive, {'align.map_frame': 'map'}, number=6)
    aligned, newest_ns = mapper.align(), drive[0][5].stamp_ns

    np.testing.assert_array_equal(mapper.T_map_of('map', newest_ns), np.eye(4))
    np.testing.assert_allclose(mapper.T_map_of('odom', newest_ns), aligned.T_map_fixed)
    for stamp_ns in (newest_ns, 0):
        np.testing.assert_allclose(
            mapper.T_map_of('lidar', stamp_ns), aligned.T_map_sensor[-1], rtol=0, atol=1e-9
        )


def test_scans_whose_columns_were_not_kept_are_refused(drive):
    mapper, _ = mapped(drive, {'map.intensity': True}, number=3)
    scans = [replace(scan, columns={}) for scan in mapper.window]
    mapper.restore(mapper.map.copy(), scans)

    with pytest.raises(AlignmentError, match='0 of 3 scans'):
        mapper.align()
