# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Inputs made by hand that ended the process, hung, escaped as another error or were believed."""

from __future__ import annotations

from dataclasses import replace
import io
from types import SimpleNamespace

import numpy as np
from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile
import pytest

from surfel_mapper.counters import Counters, OTHERS
from surfel_mapper.errors import (
    CloudFormatError,
    FileFormatError,
    MapError,
    PoseError,
    refusing,
)
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.messages.cdr import MAX_FRAME_NAME
from surfel_mapper.messages.compressed_image import unpacked
from surfel_mapper.messages.pointcloud2 import cloud_bytes, from_columns, parse_cloud, to_scan
from surfel_mapper.messages.poses import raw_poses


@pytest.mark.parametrize('error', [OverflowError('x'), AttributeError('a\nb')])
def test_any_exception_of_a_parser_becomes_an_error_of_its_reader(error):
    expected = pytest.raises(FileFormatError, match=f'a.npz: damaged, .*{type(error).__name__}')
    with expected as caught, refusing('a.npz'):
        raise error
    assert caught.value.__cause__ is error
    assert '\n' not in str(caught.value)


def test_a_jpeg_of_a_thousand_scans_is_refused_before_decoding(monkeypatch):
    """Each scan of 23 bytes passes over all pixels: 76 kB took over a minute."""
    stream = io.BytesIO()
    Image.new('RGB', (2000, 2000)).save(stream, 'JPEG', progressive=True)
    content = stream.getvalue()
    message = SimpleNamespace(header=None, format='rgb8; jpeg compressed bgr8', data=content)
    assert unpacked(message, 'color', exact=False).width == 2000
    last = content[content.rfind(b'\xff\xda') : -2]
    message.data = content[:-2] + 1000 * last + content[-2:]
    monkeypatch.setattr(JpegImageFile, 'load', pytest.fail)
    with pytest.raises(CloudFormatError, match='a JPEG of 1010 scans, expected at most 32'):
        unpacked(message, 'color', exact=False)


def test_names_of_frames_are_limited():
    """10,000 frames are kept, and 128 are counted: names of 10 MB would fill the memory."""
    columns = dict.fromkeys('xyz', np.zeros(1, np.float32))
    for size, is_valid in ((MAX_FRAME_NAME, True), (MAX_FRAME_NAME + 1, False)):
        raw = cloud_bytes(from_columns(columns), stamp_ns=1, frame_id='f' * size)
        pose = pose_bytes('odom', 'f' * size)
        if is_valid:
            assert parse_cloud(raw).header.frame_id == 'f' * size
            assert raw_poses('odometry', pose, 'base_link', 'odom')[0].child == 'f' * size
            continue
        with pytest.raises(CloudFormatError, match=r'frame .* of 257 characters'):
            to_scan(parse_cloud(raw))
        with pytest.raises(PoseError, match=r'frame .* of 257 characters'):
            raw_poses('odometry', pose, 'base_link', 'odom')


def test_drops_of_frames_with_endless_names_are_counted_together():
    counters = Counters()
    for number in range(3):
        counters.drop('bad_cloud', f'{number}' * 1_000_000)
    assert counters.dropped_by_frame == {OTHERS: {'bad_cloud': 3}}


def pose_bytes(parent, child):
    """Return the first part of a nav_msgs/Odometry, up to its pose."""
    from surfel_mapper.messages.cdr import MessageWriter, write_header

    writer = MessageWriter()
    write_header(writer, 1, parent)
    writer.string(child)
    writer.numbers('d', 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    return writer.join()


@pytest.mark.parametrize('far_m', [1e300, -2e9, np.nan, np.inf])
def test_poses_beyond_any_place_are_refused(far_m):
    """1e300 m passed as a rigid transform."""
    pose = np.eye(4)
    pose[1, 3] = far_m
    with pytest.raises(ValueError, match='expected a rigid transform'):
        SurfelMap(0.5).reduce(np.zeros((5, 3)), pose)


def taken(count):
    """Return changes of moments by name, each of which no map may take."""
    wide, twice = np.zeros((count, 7), np.int64), np.zeros(count, np.int64)
    return {
        'key': [np.zeros((1, count), np.int64), np.zeros(count - 1, np.int64), twice, None],
        'count': [np.zeros(count), np.ones(3, np.int32), -np.ones(count, np.int32)],
        'total': [np.zeros((2, 3), np.int32), np.zeros(count, np.int32), wide],
        'product': [wide, np.zeros((count, 6), '>i8'), np.zeros((count, 6), np.uint64)],
        'view': [np.zeros((count, 3)), np.zeros((1, 3), np.int16), wide],
        'channels': [np.zeros((2, 0), np.int64), np.zeros((count, 1), np.int64)],
    }


def test_moments_of_other_shapes_and_types_are_refused_before_a_kernel_reads_them():
    """Short arrays were read past their end, negative counts removed, and a voxel added twice."""
    surfel_map = SurfelMap(0.5)
    moments = surfel_map.add(np.random.default_rng(0).normal(size=(500, 3)))
    digest = surfel_map.digest()
    for name, arrays in taken(len(moments)).items():
        for array in arrays:
            for change in (surfel_map.insert, surfel_map.remove):
                with pytest.raises((MapError, TypeError, ValueError)):  # the last by ScanMoments
                    change(replace(moments, **{name: array}))
    doubled = replace(moments.select(np.repeat(np.arange(len(moments)), 2)))
    with pytest.raises(MapError, match='a voxel occurs twice'):
        surfel_map.insert(doubled)
    assert surfel_map.digest() == digest


@pytest.mark.parametrize('rows', [[-1], [10**6], [2**31 - 1], [0.5], [[0]], ['x']])
def test_rows_beyond_the_table_are_refused(rows):
    """They were read from other memory."""
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.zeros((5, 3)))
    for read in (surfel_map.surfels_of, surfel_map.keys_of):
        with pytest.raises(IndexError, match='rows'):
            read(np.array(rows))


@pytest.mark.parametrize('value', [np.nan, -1.0, -np.inf, 'x', None, 1j, [1, 2]])
@pytest.mark.parametrize('name', ['min_range_m', 'max_range_m'])
def test_ranges_that_are_no_numbers_are_refused(name, value):
    with pytest.raises(ValueError, match='min_range_m'):
        SurfelMap(0.5).reduce(np.zeros((5, 3)), **{name: value})
