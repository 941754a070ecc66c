# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Clouds with normals keep every input byte and get the surfel of each point."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from surfel_mapper.geometry import pose_matrix
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.messages.pointcloud2 import Field, to_scan
from surfel_mapper.messages.scan_normals import ADDED, scan_with_normals
from surfel_mapper.scan import Scan

POSE = pose_matrix([100.0, -3.0, 2.0], [0.0, 0.28, 0.0, 0.96])
MIN_POINTS = 4


def layout(step, order='<', named=()):
    names = ['x', 'y', 'z', 'intensity', 'ring', *named]
    formats = [f'{order}{code}' for code in ('f4', 'f4', 'f4', 'f4', 'u2', *['f4'] * len(named))]
    offsets = [0, 4, 8, 12, 17, *range(19, 19 + 4 * len(named), 4)]
    return np.dtype({'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': step})


def cloud(step=19, height=3, width=200, padding=0, order='<', named=()):
    """Return an organised cloud as drivers make them: odd offsets, padded rows, some nan."""
    rng = np.random.default_rng(step)
    rows = rng.integers(0, 256, (height, step * width + padding), np.uint8)
    dtype = layout(step, order, named)
    points = np.ndarray((height, width), dtype, rows, 0, (rows.strides[0], step))
    for axis, name in enumerate('xyz'):
        points[name] = rng.normal(scale=[0.8, 0.6, 0.1][axis], size=(height, width))
    points['x'][0, ::9] = np.nan
    points['intensity'] = rng.uniform(size=(height, width))
    codes = {'f4': 7, 'u2': 4}
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=2), frame_id='lidar'),
        height=height,
        width=width,
        fields=[
            Field(n, dtype.fields[n][1], codes[dtype.fields[n][0].str[1:]], 1) for n in dtype.names
        ],
        is_bigendian=order == '>',
        point_step=step,
        row_step=rows.shape[1],
        data=rows.tobytes(),
        is_dense=False,
    )


def as_message(content, like):
    return SimpleNamespace(
        header=like.header, **{name: getattr(content, name) for name in content.__slots__}
    )


def mapped(scan):
    surfel_map = SurfelMap(0.5)
    surfel_map.insert(surfel_map.reduce(scan.points, POSE, origin=POSE[:3, 3]))
    return surfel_map


def expected_of(scan, surfel_map):
    """Return normal, planarity and count of each point, one at a time."""
    surfels = surfel_map.surfels(MIN_POINTS)
    row_of = {tuple(index): row for row, index in enumerate(surfels.voxel_index.tolist())}
    values = np.full((len(scan), 5), np.nan)
    values[:, 4] = 0
    for i, point in enumerate(scan.points.astype(np.float64)):
        if not np.isfinite(point).all():
            continue
        place = [((R[0] * point[0] + R[1] * point[1]) + R[2] * point[2]) + R[3] for R in POSE[:3]]
        index = tuple(int(np.floor(p * (65536 / 0.5))) >> 16 for p in place)
        if index in row_of:
            row = row_of[index]
            values[i, :3] = POSE[:3, :3].T @ surfels.normal[row]
            values[i, 3], values[i, 4] = surfels.planarity[row], surfels.num_points[row]
    return values


@pytest.mark.parametrize(
    'settings', [{}, {'step': 32}, {'padding': 7}, {'height': 1}, {'order': '>'}]
)
def test_every_point_gets_its_surfel_and_keeps_its_bytes(settings):
    message = cloud(**settings)
    scan = to_scan(message)
    surfel_map = mapped(scan)

    found = as_message(scan_with_normals(scan, POSE, surfel_map, MIN_POINTS), message)

    assert (found.height, found.width) == (message.height, message.width)
    assert [f.name for f in found.fields] == [*[f.name for f in message.fields], *ADDED]
    step = message.point_step
    given = np.frombuffer(message.data, np.uint8).reshape(message.height, -1)
    kept = np.asarray(found.data).reshape(message.height, message.width, -1)[:, :, :step]
    np.testing.assert_array_equal(kept, given[:, : step * message.width].reshape(kept.shape))
    again, expected = to_scan(found), expected_of(scan, surfel_map)
    np.testing.assert_array_equal(again.points, scan.points)
    for name, values in scan.columns.items():
        np.testing.assert_array_equal(again.columns[name], values)
    for name, values in zip(ADDED, expected.T, strict=True):
        np.testing.assert_allclose(again.columns[name], values, atol=1e-6)
    assert again.columns['num_points'].dtype == np.uint32
    assert 0.5 < (expected[:, 4] > 0).mean() < 1.0


def test_fields_with_the_names_of_appended_ones_stay():
    message = cloud(step=32, named=('normal_x', 'planarity'))
    scan = to_scan(message)
    found = to_scan(as_message(scan_with_normals(scan, POSE, mapped(scan), MIN_POINTS), message))
    for name in ('normal_x', 'planarity'):
        np.testing.assert_array_equal(found.columns[name], scan.columns[name])
        assert f'surfel_{name}' in found.columns
    assert {'normal_y', 'normal_z', 'num_points'} <= set(found.columns)


def test_appended_fields_differ_from_those_that_have_their_prefix_already():
    message = cloud(
        step=35, named=('normal_x', 'surfel_normal_x', 'surfel_planarity', 'planarity')
    )
    scan = to_scan(message)
    found = scan_with_normals(scan, POSE, mapped(scan), MIN_POINTS)
    names = [field.name for field in found.fields]
    assert len(set(names)) == len(names)
    assert names[-5:] == [
        'surfel_surfel_normal_x',
        'normal_y',
        'normal_z',
        'surfel_surfel_planarity',
        'num_points',
    ]


def test_an_empty_map_gives_nan():
    message = cloud()
    scan = to_scan(message)
    found = to_scan(as_message(scan_with_normals(scan, POSE, SurfelMap(0.5), 1), message))
    assert (found.columns['num_points'] == 0).all()
    assert np.isnan(found.columns['planarity']).all()


def test_a_scan_without_a_message_becomes_a_cloud():
    points = np.random.default_rng(1).normal(scale=[0.8, 0.6, 0.1], size=(500, 3))
    points = points.astype(np.float32)
    scan = Scan(points=points, stamp_ns=5, frame_id='camera', columns={'score': points[:, 0]})
    surfel_map = mapped(scan)
    content = scan_with_normals(scan, POSE, surfel_map, MIN_POINTS)
    found = to_scan(as_message(content, cloud()))
    np.testing.assert_array_equal(found.points, points)
    np.testing.assert_array_equal(found.columns['score'], points[:, 0])
    for name, values in zip(ADDED, expected_of(scan, surfel_map).T, strict=True):
        np.testing.assert_allclose(found.columns[name], values, atol=1e-6)
