# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The layout of raw numbers follows from their values and sizes, or is asked for."""

from pathlib import Path

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.raw import raw_layout
from surfel_mapper.files.scan_files import read_scan, scan_files, scan_reader

N = 600


def room(seed=0, n=N):
    """Return points on the walls of a room of 12 x 8 x 3 m, in random order."""
    rng = np.random.default_rng(seed)
    rays = rng.normal(size=(n, 3)) * (1.0, 1.0, 0.6)
    return rays * (np.array([6.0, 4.0, 1.5]) / np.abs(rays)).min(axis=1)[:, None]


def table(width, seed=0, n=N):
    points = room(seed, n)
    further = (
        np.abs(points[:, 0]) * 20.0,
        np.arange(n) % 32,
        np.linspace(0.0, 0.1, n),
    )
    return np.column_stack([points, *further[: width - 3]])


@pytest.mark.parametrize('type_', ['<f4', '<f8'])
@pytest.mark.parametrize('width', [3, 4, 5, 6])
def test_type_and_width_follow_from_the_values(tmp_path, width, type_):
    files = [tmp_path / f'{seed}.bin' for seed in range(3)]
    for seed, file in enumerate(files):
        table(width, seed, N + 4 * seed).astype(type_).tofile(file)  # 12 divides N

    assert raw_layout(files) == (np.dtype(type_), width)
    for seed, file in enumerate(files):
        for points, _ in (read_scan(file), scan_reader(files)(file)):
            np.testing.assert_allclose(points, table(width, seed, N + 4 * seed)[:, :3], rtol=1e-6)


@pytest.mark.parametrize(
    ('further', 'width'),
    [
        (np.full((N, 2), [100.0, -1.0]), 5),  # Lyft
        (np.zeros((N, 1)), 4),
        (np.random.default_rng(1).integers(0, 256, (N, 3)), 6),
        (np.tile([0.0, 0.6, -0.8], (N, 1)), 6),
    ],
)
def test_constants_colours_and_normals_are_columns(tmp_path, further, width):
    np.column_stack([room(), further]).astype('<f4').tofile(tmp_path / 'a.bin')

    assert raw_layout([tmp_path / 'a.bin']).width == width


def test_float64_that_are_round_are_not_taken_for_float32(tmp_path):
    table(4).astype('<f4').astype('<f8').round(1).astype('<f4').astype('<f8').tofile(
        tmp_path / 'a.bin'
    )

    assert raw_layout([tmp_path / 'a.bin']) == (np.dtype('<f8'), 4)


def test_one_cut_file_does_not_change_the_layout_of_the_others(tmp_path):
    for seed in range(5):
        table(5, seed).astype('<f4').tofile(tmp_path / f'{seed}.bin')
    cut = tmp_path / '3.bin'
    cut.write_bytes(cut.read_bytes()[:-7])
    read = scan_reader(scan_files(tmp_path))

    points, columns = read(tmp_path / '4.bin')

    np.testing.assert_array_equal(points, room(4).astype('<f4'))
    np.testing.assert_array_equal(columns['ring'], np.arange(N) % 32)
    with pytest.raises(FileFormatError, match=r'3\.bin: 11993 bytes, expected 20 for every point'):
        read(cut)


def test_columns_that_are_asked_for_win(tmp_path):
    table(3).astype('<f4').tofile(tmp_path / 'a.bin')

    points, columns = scan_reader([tmp_path / 'a.bin'], 6)(tmp_path / 'a.bin')

    assert len(points) == N // 2
    assert len(columns) == 3


def test_random_bytes_are_refused_with_the_option(tmp_path):
    content = np.random.default_rng(2).integers(0, 256, 4800).astype('u1')
    content.tofile(tmp_path / 'a.bin')

    with pytest.raises(FileFormatError, match=r'expected points of 3, 4, 5, 6 columns.*--bin-col'):
        read_scan(tmp_path / 'a.bin')


@pytest.mark.parametrize('width', [3, 4, 5, 6])
def test_real_scans_keep_their_width(data_folder, tmp_path, width):
    for file in scan_files(Path(data_folder, 'data', 'scans')):
        points, columns = read_scan(file)
        is_hit = np.isfinite(points).all(axis=1)
        points = points[is_hit]
        intensity = columns.get('intensity', points[:, 0] ** 2)[: len(is_hit)]
        intensity = intensity[is_hit] if len(intensity) == len(is_hit) else intensity
        ring, time = np.arange(len(points)) % 16, np.linspace(0.0, 0.1, len(points))
        rows = np.column_stack([points, intensity, ring, time])[:, :width]
        rows.astype('<f4').tofile(tmp_path / 'a.bin')

        assert raw_layout([tmp_path / 'a.bin']).width == width, file.name
