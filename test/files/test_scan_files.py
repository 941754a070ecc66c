# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scans in files are read with all their columns, in the order of their numbers."""

from pathlib import Path

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.scan_files import read_scan, scan_files

POINTS = np.arange(12, dtype=np.float32).reshape(4, 3)
COLUMNS = {**dict(zip('xyz', POINTS.T, strict=True)), 'intensity': np.arange(4, dtype='f4')}


def test_every_format_gives_the_same_scan(tmp_path):
    ply.write_points(tmp_path / 'a.ply', COLUMNS)
    pcd.write_points(tmp_path / 'a.pcd', COLUMNS)
    table = np.column_stack(list(COLUMNS.values())).astype('<f4')
    table.tofile(tmp_path / 'a.bin')
    np.column_stack([table, [1, 2, 3, 4]]).astype('<f4').tofile(tmp_path / 'a.pcd.bin')

    for name in ('a.ply', 'a.pcd', 'a.bin', 'a.pcd.bin'):
        points, columns = read_scan(tmp_path / name)
        assert (
            points.flags.f_contiguous
        )  # as decoded clouds are; others would compile kernels anew
        np.testing.assert_array_equal(points, POINTS)
        assert points.dtype == np.float32
        np.testing.assert_array_equal(columns['intensity'], COLUMNS['intensity'])
    np.testing.assert_array_equal(columns['ring'], [1, 2, 3, 4])


def test_files_come_in_the_order_of_their_numbers(tmp_path):
    for name in ('10.bin', '9.ply', 'notes.txt', '100.pcd'):
        (tmp_path / name).touch()
    (tmp_path / '1.bin').mkdir()

    assert [path.name for path in scan_files(tmp_path)] == ['9.ply', '10.bin', '100.pcd']


def test_hidden_files_are_no_scans(tmp_path):
    for name in ('1.pcd', '._1.pcd', '.DS_Store', '.2.ply'):
        (tmp_path / name).write_bytes(b'\0\5\x16\7')

    assert [path.name for path in scan_files(tmp_path)] == ['1.pcd']


def test_endings_in_capitals_are_those_of_scans(tmp_path):
    table = np.column_stack(list(COLUMNS.values())).astype('<f4')
    table.tofile(tmp_path / '1.BIN')
    np.column_stack([table, [1, 2, 3, 4]]).astype('<f4').tofile(tmp_path / '2.PCD.BIN')
    pcd.write_points(tmp_path / '3.Pcd', COLUMNS)

    files = scan_files(tmp_path)

    assert [path.name for path in files] == ['1.BIN', '2.PCD.BIN', '3.Pcd']
    for file in files:
        np.testing.assert_array_equal(read_scan(file)[0], POINTS)


def test_a_link_that_leads_nowhere_is_a_scan_that_cannot_be_read(tmp_path):
    (tmp_path / '1.bin').symlink_to(tmp_path / 'none')

    (file,) = scan_files(tmp_path)

    with pytest.raises(FileFormatError, match=r'1\.bin: cannot be read: No such file'):
        read_scan(file)


@pytest.mark.parametrize(
    ('name', 'write', 'says'),
    [
        (
            'a.bin',
            lambda path: path.write_bytes(bytes(17)),
            '17 bytes, expected points of 3, 4, 5, 6 columns, .* --bin-columns',
        ),
        (
            'a.pcd.bin',
            lambda path: path.write_bytes(bytes(16)),
            '16 bytes, expected points of 5 columns',
        ),
        ('a.bin', lambda path: None, 'cannot be read'),
        ('a.stl', lambda path: path.touch(), 'expected a scan ending in .ply, .pcd, .bin'),
        ('a.ply', lambda path: ply.write_points(path, {'x': POINTS[:, 0]}), 'no y, z among x'),
        (
            'a.pcd',
            lambda path: pcd.write_points(path, {n: np.zeros(2, np.int32) for n in 'xyz'}),
            'x, y, z of int32, int32, int32, expected float',
        ),
    ],
)
def test_files_that_are_not_scans_are_refused(tmp_path, name, write, says):
    write(tmp_path / name)

    with pytest.raises(FileFormatError, match=says):
        read_scan(tmp_path / name)


def test_real_scans_of_fourteen_sensors_are_read(data_folder):
    files = scan_files(Path(data_folder, 'data', 'scans'))

    sizes = {}
    for file in files:
        points, columns = read_scan(file)
        assert np.isfinite(points).any(axis=1).mean() > 0.5
        assert all(len(values) == len(points) for values in columns.values())
        sizes[file.name] = len(points)

    assert len(sizes) == 16
    assert sizes['pjlab_64beam_street_ring_timestamp.pcd'] == 80787
    assert sizes['rellis3d_os1_64_offroad_000104.bin'] == 131072
