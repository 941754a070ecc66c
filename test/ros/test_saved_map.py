# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The directory and the file that ``~/save_map`` writes are input of the other verbs."""

import json

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.config import Config
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.parquet_tiles import read_tiles
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.checkpoints import load_start
from surfel_mapper.scan import Scan
from test import extras

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')


@pytest.fixture(scope='module')
def saved(tmp_path_factory):
    """Return the output directory of ~/save_map and the mapper that wrote it."""
    extras.load('pyarrow')  # to merge it
    from surfel_mapper.ros.map_files import save_map

    directory = tmp_path_factory.mktemp('maps')
    settings = {'pose.source': 'identity', 'output.directory': str(directory)}
    mapper = Mapper(Config.from_mapping(settings))
    rng = np.random.default_rng(0)
    for number in range(3):
        points = rng.uniform(-3.0, 3.0, (4000, 3)).astype(np.float32)
        points[:, number] = 0.01
        mapper.add_scan(Scan(points=points, stamp_ns=10**9 + number, frame_id='odom'))
        assert len(list(mapper.insert_ready())) == 1
    save_map(mapper)
    return directory, mapper


@pytest.mark.parametrize('name', ['', 'map.npz'])
def test_a_saved_map_is_merged_extracted_evaluated_and_loaded(saved, name, tmp_path, capsys):
    directory, mapper = saved
    path, digest = str(directory / name), mapper.map.digest()

    assert main(['merge', path, '--output', str(tmp_path / 'sum')]) == 0
    assert read_tiles(tmp_path / 'sum' / 'map').digest() == digest
    assert main(['extract', path, '--output', str(tmp_path / 'models')]) == 0
    assert (tmp_path / 'models' / 'models.json').is_file()
    capsys.readouterr()
    assert main(['evaluate', path, '--truth', str(tmp_path / 'sum'), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['equal'] is True
    loaded = Mapper(Config.from_mapping({'pose.source': 'identity', 'map.load': path}))
    load_start(loaded)
    assert loaded.map.digest() == digest


def test_merging_a_saved_map_with_itself_warns(saved, tmp_path, caplog):
    directory, _ = saved
    output = str(tmp_path / 'sum')
    assert main(['merge', str(directory), str(directory), '--output', output]) == 0
    assert '3 of its 3 scans have stamps of scans in' in caplog.text


def test_saving_where_a_file_has_the_name_of_the_directory_is_refused(tmp_path):
    from surfel_mapper.ros.map_files import save_map

    (tmp_path / 'maps').write_bytes(b'mine')
    settings = {'pose.source': 'identity', 'output.directory': str(tmp_path / 'maps')}
    said = f'{tmp_path}/maps: {tmp_path}/maps is a file, expected a directory'
    with pytest.raises(FileFormatError, match=f'^{said}$'):
        save_map(Mapper(Config.from_mapping(settings)))
    assert (tmp_path / 'maps').read_bytes() == b'mine'
