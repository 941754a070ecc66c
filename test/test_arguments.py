# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Numbers and objects that no argument of the public functions can hold are refused as such.

Integers of Python have no limit: 2^70 fails in a kernel, and 2^1025 when it becomes a float, with
an OverflowError or pages of compiler errors. Callers catch ValueError, TypeError and the errors of
this package.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
import traceback
from types import SimpleNamespace

import numpy as np
import pytest

import surfel_mapper
from surfel_mapper import (
    Config,
    diff,
    DistanceField,
    estimate_normals,
    MapMirror,
    Mapper,
    replay,
    Scan,
    show,
    SlidingWindow,
    Surfel,
    SurfelMap,
    Trajectory,
)
from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import SurfelMapperError
from surfel_mapper.files.trajectory import write_tum

PACKAGE = Path(surfel_mapper.__file__).parent

POINTS = np.random.default_rng(0).uniform(-2.0, 2.0, (300, 3))

HOSTILE = (
    *(sign * size for size in (2**1025, 10**30, 2**64) for sign in (1, -1)),
    *(float('nan'), float('inf'), -1e308, np.longdouble('1e4000'), np.uint64(2**64 - 1)),
    *('x', '٣', b'1', 1j, {}, object(), np.datetime64('NaT'), np.array([2**70], object)),
    *([2**1025], [[2**1025] * 3], [[1, 2], [3]], (2**1025,) * 3, np.full((3, 3), 2**70, object)),
    *(None, True, [], {1}, slice(0, 2), Path('a'), datetime(2024, 1, 1), len, dict, 1.5, -1),
    *(
        np.ones((3, 2)),
        np.ones((2, 3, 4)),
        np.ones((4, 3), bool),
        np.array(3.0),
        np.array([['a']]),
    ),
    *(np.zeros(4, [('x', 'f4')]), np.zeros((4, 3), 'm8[ns]'), np.ones((4, 3), np.float16)),
)
"""Wrong values for an argument; a call succeeds if a value is legal for it."""


def surfel_map():
    made = SurfelMap(0.5)
    made.add(POINTS)
    return made


def field():
    made = DistanceField()
    made.add(POINTS, np.eye(4))
    return made


CALLS = {
    'SurfelMap(voxel_size_m)': lambda v: SurfelMap(v),
    'SurfelMap(origin_m)': lambda v: SurfelMap(0.5, origin_m=v),
    'SurfelMap(level)': lambda v: SurfelMap(0.5, level=v),
    'MapMirror': lambda v: MapMirror(v),
    'add(points)': lambda v: surfel_map().add(v),
    'add(origin)': lambda v: surfel_map().add(POINTS, origin=v),
    'add(T_map_sensor)': lambda v: surfel_map().add(POINTS, v),
    'reduce(min_range_m)': lambda v: surfel_map().reduce(POINTS, min_range_m=v),
    'surfels(min_points)': lambda v: surfel_map().surfels(v),
    'surfels(at_most)': lambda v: surfel_map().surfels(5, v),
    'num_surfels': lambda v: surfel_map().num_surfels(v),
    'surfels_changed(since)': lambda v: surfel_map().surfels_changed(v),
    'surfels_changed(min_points)': lambda v: surfel_map().surfels_changed(0, v),
    'rows_changed': lambda v: surfel_map().rows_changed(v),
    'keys': lambda v: surfel_map().keys(v),
    'index': lambda v: surfel_map().index(v),
    'coarsen': lambda v: surfel_map().coarsen(v),
    'at_origin': lambda v: surfel_map().at_origin(v),
    'remove(min_points)': lambda v: SurfelMap(0.5).remove(SurfelMap(0.5).moments(), v),
    'diff(min_points)': lambda v: diff(surfel_map(), surfel_map(), min_points=v),
    'show(min_points)': lambda v: show(surfel_map(), min_points=v),
    'estimate_normals(points)': lambda v: estimate_normals(v),
    'estimate_normals(max_distance_m)': lambda v: estimate_normals(POINTS, max_distance_m=v),
    'estimate_normals(viewpoint)': lambda v: estimate_normals(POINTS, viewpoint=v),
    'DistanceField.add(T_map_sensor)': lambda v: DistanceField().add(POINTS, v),
    'DistanceField.add(stamp_ns)': lambda v: DistanceField().add(
        POINTS[:0], np.eye(4), stamp_ns=v
    ),
    'DistanceField.sample': lambda v: DistanceField().sample(v),
    'DistanceField.states': lambda v: DistanceField().states(v),
    'obstacle_distances(low_m)': lambda v: field().obstacle_distances(low_m=v),
    'obstacle_distances(high_m)': lambda v: field().obstacle_distances(high_m=v),
    'DistanceField.add(points)': lambda v: DistanceField().add(v, np.eye(4)),
    'DistanceField.add(colors)': lambda v: DistanceField().add(POINTS, np.eye(4), colors=v),
    'DistanceField.esdf': lambda v: field().esdf(max_m=v),
    'Trajectory.from_matrices': lambda v: Trajectory.from_matrices(v),
    'Trajectory(stamp_ns)': lambda v: Trajectory(v, np.zeros((1, 3)), np.ones((1, 4))),
    'Trajectory(xyz)': lambda v: Trajectory(None, v, np.ones((1, 4))),
    'SurfelMap(columns)': lambda v: SurfelMap(0.5, columns=v),
    'add(columns)': lambda v: surfel_map().add(POINTS, columns=v),
    'coarsen(within)': lambda v: surfel_map().coarsen(1, v),
    'surfels_of': lambda v: surfel_map().surfels_of(v),
    'find': lambda v: surfel_map().find(v),
    'moments': lambda v: surfel_map().moments(v),
    'moments.select': lambda v: surfel_map().moments().select(v),
    'surfels.select': lambda v: surfel_map().surfels().select(v),
    'Surfel': lambda v: Surfel(v),
    'SlidingWindow(max_voxels)': lambda v: SlidingWindow(SurfelMap(0.5), max_voxels=v),
    'move(min_points)': lambda v: SlidingWindow(SurfelMap(0.5)).move({}, v),
    'drop_voxels': lambda v: SlidingWindow(surfel_map()).drop_voxels(v),
    'diff(angle_deg)': lambda v: diff(surfel_map(), surfel_map(), angle_deg=v),
    'show(place)': lambda v: show(surfel_map(), place=v),
    'Scan(points)': lambda v: Scan(points=v, stamp_ns=0, frame_id='a'),
    'Scan(stamp_ns)': lambda v: Scan(points=POINTS, stamp_ns=v, frame_id='a'),
    'Scan(columns)': lambda v: Scan(points=POINTS, stamp_ns=0, frame_id='a', columns=v),
    'Scan(T_map_sensor)': lambda v: Scan(points=POINTS, stamp_ns=0, frame_id='a', T_map_sensor=v),
    'Scan.select': lambda v: Scan(points=POINTS, stamp_ns=0, frame_id='a').select(v),
    'add_pose(stamp_ns)': lambda v: Mapper().add_pose('a', 'b', v, (0, 0, 0), (0, 0, 0, 1)),
    'T_map_of': lambda v: Mapper().T_map_of(v, 0),
    'Mapper.surfels': lambda v: Mapper().surfels(v),
    'Config.stage': lambda v: Config().stage(v),
}


@pytest.mark.parametrize('name', CALLS)
def test_hostile_arguments_are_refused_or_used(name):
    refusals = []
    for value in HOSTILE:
        try:
            CALLS[name](value)
        except (SurfelMapperError, ValueError, TypeError, IndexError) as error:
            refusals.append(error)
    assert len(refusals) >= 8
    for refusal in refusals:  # by a sentence of this package, not from the depths of NumPy
        place = traceback.extract_tb(refusal.__traceback__)[-1].filename
        assert Path(place).is_relative_to(PACKAGE), refusal
        assert str(refusal)


def test_a_tensor_on_a_graphics_card_is_refused_with_its_reason():
    class Tensor:
        def __array__(self, dtype=None, copy=None):
            raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu()")

    for call in (SurfelMap(0.5).add, estimate_normals, Surfel, DistanceField().sample):
        with pytest.raises(ValueError, match=r'a Tensor .*Use Tensor\.cpu\(\).*expected numbers'):
            call(Tensor())


def test_masked_points_are_left_out():
    """NumPy makes an array of the values under the mask."""
    masked = np.ma.masked_array(POINTS, np.zeros(POINTS.shape, bool))
    masked[7:50, 1] = np.ma.masked
    kept, found = SurfelMap(0.5), SurfelMap(0.5)
    kept.add(np.delete(POINTS, slice(7, 50), axis=0))
    moments = found.add(masked)
    assert found.digest() == kept.digest()
    assert moments.left_out == {'not_finite': 43}
    with pytest.raises(ValueError, match=r'MaskedArray, expected an array: points\.filled'):
        Scan(points=masked, stamp_ns=0, frame_id='lidar')


KINDS = {
    'map': lambda v: Config(map=v),
    'more': lambda v: Config(more=v),
    'a': lambda v: Config.from_mapping(v),
    'config': lambda v: DistanceField(v),
    'blocks': lambda v: DistanceField(blocks=v),
    'sensor': lambda v: DistanceField().add(POINTS, np.eye(4), sensor=v),
    'camera': lambda v: DistanceField().add_depth(np.ones((4, 4)), v, np.eye(4)),
    'path': lambda v: field().save(v),
    'path ': lambda v: DistanceField.load(v, TsdfConfig()),
    'config: ': lambda v: DistanceField.load('missing.npz', v),
    'columns': lambda v: MapMirror(0.5, v),
    'points': lambda v: MapMirror(0.5).replace(v),
    'points: ': lambda v: MapMirror(0.5).change(v),
    'scan': lambda v: Mapper().add_scan(v),
    'image': lambda v: Mapper().add_image(v),
    'region': lambda v: Mapper().clear_region(v),
    'surfel_map': lambda v: Mapper().restore(v, []),
    'scans': lambda v: Mapper().restore(SurfelMap(0.5), [v]),
    'config ': lambda v: Mapper().reconfigure(v),
    'times': lambda v: Scan(points=POINTS, stamp_ns=0, frame_id='a', times=v),
    'depth': lambda v: Scan(points=POINTS, stamp_ns=0, frame_id='a', depth=v),
    'surfel_map ': lambda v: SlidingWindow(v),
    'config  ': lambda v: SlidingWindow(SurfelMap(0.5), v),
    'scan ': lambda v: SlidingWindow(SurfelMap(0.5)).insert(v),
    'scans ': lambda v: SlidingWindow(SurfelMap(0.5)).restore(v),
    'scans  ': lambda v: SlidingWindow(SurfelMap(0.5)).move(v),
    'columns ': lambda v: SurfelMap(0.5, columns=v),
    'options': lambda v: replay('missing', options=v),
    'progress': lambda v: replay('missing', progress=v),
    'num_points': lambda v: Surfel.from_stats([0.0] * 3, [0.0] * 6, v),
    ' ScanMoments': lambda v: SurfelMap(0.5).insert(v),
    ' SurfelMap': lambda v: SurfelMap(0.5).merge(v),
    'diff': lambda v: diff(v, SurfelMap(0.5)),
    ' SurfelMap or Surfels': lambda v: show(v),
}
"""Calls with an argument of a class, by a name in the error."""


@pytest.mark.parametrize('name', KINDS)
def test_an_object_of_another_class_is_refused_by_name(name):
    for value in (3.5, object(), SimpleNamespace()):
        with pytest.raises((SurfelMapperError, TypeError, ValueError)) as refused:
            KINDS[name](value)
        assert name.strip(' :') in str(refused.value)
        assert 'expected' in str(refused.value)


def test_complex_numbers_are_refused():
    """Their imaginary part was left out, with a warning."""
    with pytest.raises(ValueError, match='origin: a list, expected numbers'):
        SurfelMap(0.5).reduce(POINTS, origin=[1j, 0.0, 0.0])


def test_whole_numbers_beyond_64_bits_are_named():
    for call in (SurfelMap.surfels, SurfelMap.keys, SurfelMap.num_surfels):
        with pytest.raises(ValueError, match='min_points: a number of 100 bits, expected'):
            call(SurfelMap(0.5), 10**30)
    with pytest.raises(ValueError, match='voxel_size_m: a int, expected numbers'):
        SurfelMap(2**1025)


def test_a_distance_whose_square_is_infinite_is_no_limit():
    expected = estimate_normals(POINTS)
    np.testing.assert_array_equal(estimate_normals(POINTS, max_distance_m=1e308), expected)


def test_any_true_value_compresses_a_distance_field(tmp_path):
    """The number was taken for a method of packing."""
    field().save(tmp_path / 'a.npz', compress=7)
    assert len(DistanceField.load(tmp_path / 'a.npz', TsdfConfig())) == len(field())


def test_poses_that_are_no_numbers_are_not_written(tmp_path):
    with pytest.raises(ValueError, match='T_fixed_sensor'):
        write_tum(tmp_path / 'a.txt', [1], [[[2**1025] * 4] * 4])
    assert not [*tmp_path.iterdir()]
