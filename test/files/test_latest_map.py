# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The map of an output directory is the one that was written last."""

import os

import pytest

from surfel_mapper.files.latest_map import DRAWABLE, EXACT, map_in, RESTORABLE

SECOND_NS = 10**9


def write(path, written_s):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b'')
    os.utime(path, ns=(0, written_s * SECOND_NS))


def tile(directory, i):
    return directory / f'tile_i={i}' / 'tile_j=0' / 'surfels.parquet'


@pytest.mark.parametrize('newest', DRAWABLE)
def test_the_newest_form_is_returned(tmp_path, newest):
    for name in ('map.ply', 'map.npz', 'map.parquet', 'map.pcd'):
        write(tmp_path / name, 9 if name == newest else 5)
    write(tile(tmp_path / 'map', 0), 9 if newest == 'map' else 5)
    assert map_in(tmp_path, DRAWABLE) == tmp_path / newest


def test_the_newest_tile_counts(tmp_path):
    write(tmp_path / 'map.npz', 6)
    for i, written_s in ((-1, 1), (0, 7), (1, 2)):
        write(tile(tmp_path / 'map', i), written_s)
    assert map_in(tmp_path, EXACT) == tmp_path / 'map'
    assert map_in(tmp_path / 'map', EXACT) == tmp_path / 'map'
    write(tmp_path / 'map.npz', 8)
    assert map_in(tmp_path, EXACT) == tmp_path / 'map.npz'


def test_the_more_exact_form_of_equal_times_is_returned(tmp_path):
    for name in ('pcd', 'ply', 'parquet', 'npz'):
        write(tmp_path / f'map.{name}', 5)
        assert map_in(tmp_path, DRAWABLE) == tmp_path / f'map.{name}'
    write(tile(tmp_path / 'map', 0), 5)
    assert map_in(tmp_path, DRAWABLE) == tmp_path / 'map.npz'


def test_forms_that_the_caller_cannot_read_are_passed_over(tmp_path):
    write(tmp_path / 'map.npz', 1)
    write(tmp_path / 'map.parquet', 2)
    write(tmp_path / 'map.ply', 3)
    assert map_in(tmp_path, DRAWABLE) == tmp_path / 'map.ply'
    assert map_in(tmp_path, EXACT) == tmp_path / 'map.parquet'
    assert map_in(tmp_path, RESTORABLE) == tmp_path / 'map.npz'


def test_directories_of_other_content_hold_no_map(tmp_path):
    (tmp_path / 'map.npz').mkdir()
    write(tmp_path / 'map' / 'thesis.txt', 1)
    write(tmp_path / 'mesh.ply', 1)
    assert map_in(tmp_path, DRAWABLE) is None
    assert map_in(tmp_path / 'mesh.ply', DRAWABLE) is None
    assert map_in(tmp_path / 'none', DRAWABLE) is None
