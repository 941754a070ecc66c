# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""All verbs read one map of a directory with files of several runs: the one written last."""

from argparse import Namespace
import json
import os

import numpy as np
import pytest

from surfel_mapper.cli.extract import read
from surfel_mapper.cli.main import main
from surfel_mapper.files.latest_map import DRAWABLE, map_in
from surfel_mapper.files.parquet_tiles import write_tiles
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.offline.outputs import ScanTrajectory, write_maps
from surfel_mapper.pipeline.saved_state import load_mapper
from surfel_mapper.viz.contents import contents
from test import extras
from test.pipeline.made_scans import insert, mapper_with, scan_at

extras.load('pyarrow')

LENGTHS_M = {'tiles': 4.0, 'map.npz': 6.0, 'map.parquet': 8.0}
"""Length of the floor in the map of each form."""


def floor(length_m):
    rng = np.random.default_rng(1)
    surfel_map = SurfelMap(0.5)
    points = rng.uniform(0.0, [length_m, 4.0, 0.02], (4000, 3)).astype(np.float32)
    surfel_map.add(points, origin=(2.0, 2.0, 1.5))
    return surfel_map


def written(directory, newest, forms):
    """Write maps of several forms, one of them last; return that map."""
    directory.mkdir()
    maps = {form: floor(LENGTHS_M[form]) for form in forms}
    for form, surfel_map in maps.items():
        if form == 'tiles':
            write_tiles(directory / 'map', surfel_map)
        else:
            surfel_map.save(directory / form)
    for path in filter(os.path.isfile, directory.rglob('*')):
        form = path.name if path.name in forms else 'tiles'
        os.utime(path, ns=(0, (2 if form == newest else 1) * 10**18))
    return maps[newest]


@pytest.mark.parametrize('newest', LENGTHS_M)
def test_evaluate_merge_extract_and_view_read_the_map_written_last(tmp_path, newest, capsys):
    out = tmp_path / 'out'
    expected = written(out, newest, LENGTHS_M)
    expected.save(tmp_path / 'expected.npz')

    assert main(['evaluate', str(out), '--truth', str(tmp_path / 'expected.npz'), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['equal'] is True
    assert main(['merge', str(out), '--output', str(tmp_path / 'sum'), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['digest'] == expected.digest()
    (shown,) = contents(out)
    assert len(shown.shape) == expected.num_voxels
    points, *_ = read(Namespace(cloud=out, viewpoint=None, voxel_size=None, settings=[]))
    assert points[:, 0].max() == pytest.approx(LENGTHS_M[newest], abs=0.3)


@pytest.mark.parametrize('newest', LENGTHS_M)
def test_a_map_is_loaded_from_the_form_written_last(tmp_path, newest):
    out = tmp_path / 'out'
    expected = written(out, newest, LENGTHS_M)
    assert SurfelMap.load(out) == expected


@pytest.mark.parametrize('newest', ['map.npz', 'tiles'])
def test_mapping_continues_from_the_map_written_last(tmp_path, newest):
    out = tmp_path / 'out'
    expected = written(out, newest, ('map.npz', 'tiles'))
    mapper = mapper_with()
    load_mapper(out, mapper)
    assert mapper.map.digest() == expected.digest()


def test_an_exact_map_is_the_last_that_a_run_writes(tmp_path):
    mapper = mapper_with(pose__source='identity')
    (_,) = insert(mapper, scan_at(1.0))
    write_maps(tmp_path, ('npz', 'pcd', 'ply', 'parquet'), mapper, ScanTrajectory(mapper))
    assert map_in(tmp_path, DRAWABLE) == tmp_path / 'map.npz'
