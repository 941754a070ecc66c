# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Surfels read from messages, and the page that states the offsets of their fields."""

from dataclasses import fields
from pathlib import Path
import re
from types import SimpleNamespace

import numpy as np
import pytest

from surfel_mapper import SurfelMap, Surfels
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.mapping.surfels import concatenated, surfel_columns
from surfel_mapper.messages.map_cloud import moment_cloud
from surfel_mapper.messages.pointcloud2 import from_columns

PAGE = Path(__file__).parents[2] / 'docs' / 'subscribing.md'
TYPES = {7: 'float32', 6: 'uint32'}

FLOATS = ('thickness', 'normal_sigma', 'radius', 'size')


def message(cloud):
    """Return a cloud as a message of a library without ROS."""
    stamp = SimpleNamespace(sec=1, nanosec=0)
    header = SimpleNamespace(stamp=stamp, frame_id='odom')
    return SimpleNamespace(
        header=header, **{f.name: getattr(cloud, f.name) for f in fields(cloud)}
    )


def some_map(**columns):
    surfel_map = SurfelMap(0.5, columns=tuple(columns))
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (2000, 3))
    surfel_map.add(points, origin=(0.0, 0.0, 5.0), columns=columns)
    return surfel_map


def test_surfels_of_a_message_are_those_of_the_map_rounded_to_float32():
    rgb = np.random.default_rng(1).integers(0, 256, (2000, 3)).astype(np.uint8)
    surfels = some_map(intensity=np.arange(2000.0), rgb=rgb).surfels()

    found = Surfels.from_message(message(from_columns(surfel_columns(surfels))))

    for name in ('position', 'normal', 'planarity', 'curvature', *FLOATS):
        expected = getattr(surfels, name).astype(np.float32)
        np.testing.assert_array_equal(getattr(found, name), expected)
        assert getattr(found, name).dtype == np.float64
    np.testing.assert_array_equal(found.num_points, surfels.num_points)
    np.testing.assert_array_equal(found.num_scans, surfels.num_scans)
    assert found.covariance is None
    np.testing.assert_allclose(
        found.channels['intensity'], surfels.channels['intensity'], rtol=1e-7
    )
    for name in ('red', 'green', 'blue'):
        np.testing.assert_array_equal(found.channels[name], np.rint(surfels.channels[name]))
    assert np.isnan(found.eigenvalues).all()
    assert (found.voxel_index == -(2**31)).all()


def test_a_message_with_moments_has_the_voxels_and_leaves_out_empty_ones():
    surfel_map = some_map()
    surfels = surfel_map.surfels()
    cloud = moment_cloud(surfels, surfel_map.moments(), np.array([[9, 9, 9]], np.int32))

    found = Surfels.from_message(message(cloud))

    assert len(found) == len(surfels)
    expected = {tuple(row) for row in surfels.voxel_index.tolist()}
    assert {tuple(row) for row in found.voxel_index.tolist()} == expected


@pytest.mark.parametrize('has_moments', [False, True])
def test_covariances_come_with_a_message_that_has_them(has_moments):
    surfel_map = some_map()
    surfels = surfel_map.surfels(covariance=True)
    surfels = surfels.select(np.lexsort(surfels.voxel_index.T[::-1]))
    cloud = from_columns(surfel_columns(surfels))
    if has_moments:
        cloud = moment_cloud(surfels, surfel_map.moments(), np.array([[9, 9, 9]], np.int32))

    found = Surfels.from_message(message(cloud))

    np.testing.assert_array_equal(found.covariance, surfels.covariance.astype(np.float32))


def test_the_quality_of_a_message_follows_its_selected_and_joined_rows():
    surfels = some_map().surfels(5)

    found = Surfels.from_message(message(from_columns(surfel_columns(surfels))))

    joined = concatenated([found[:3], found[3:]])
    for name in FLOATS[:3]:
        np.testing.assert_array_equal(
            getattr(joined, name), getattr(surfels, name).astype(np.float32), err_msg=name
        )


def test_a_message_of_an_earlier_version_has_no_quality():
    surfels = some_map().surfels()
    columns = surfel_columns(surfels)
    for name in (*FLOATS, 'num_scans'):
        del columns[name]

    found = Surfels.from_message(message(from_columns(columns)))

    assert np.isnan([getattr(found, name) for name in FLOATS]).all()
    assert not found.num_scans.any()
    np.testing.assert_array_equal(found.num_points, surfels.num_points)


def test_an_empty_map_gives_no_surfels():
    cloud = from_columns(surfel_columns(SurfelMap(0.5).surfels()))
    assert len(Surfels.from_message(message(cloud))) == 0


def test_a_cloud_that_is_none_of_surfels_is_refused():
    cloud = from_columns({name: np.zeros(3, np.float32) for name in 'xyz'})
    with pytest.raises(CloudFormatError, match=r'no field normal_x, .*, num_points, expected'):
        Surfels.from_message(message(cloud))
    with pytest.raises(CloudFormatError, match='expected a PointCloud2'):
        Surfels.from_message(7)


def test_the_page_states_the_offsets_of_the_message():
    cloud = from_columns(surfel_columns(some_map().surfels()))
    rows = re.findall(r'^\| (`.+`) \| ([\d, ]+) \| (\w+) \|', PAGE.read_text(), flags=re.MULTILINE)
    stated = [
        (name, int(offset), kind)
        for names, offsets, kind in rows
        for name, offset in zip(re.findall('`(.+?)`', names), offsets.split(','), strict=True)
    ]
    assert stated == [(field.name, field.offset, TYPES[field.datatype]) for field in cloud.fields]
    assert f'A row has {cloud.point_step} bytes' in PAGE.read_text()
