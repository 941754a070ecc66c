# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A wrong SURFEL_MAPPER_MAX_BYTES is reported as such, not as damage of the input."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from surfel_mapper.budget import VARIABLE
from surfel_mapper.cli.main import main
from surfel_mapper.errors import ConfigError
from surfel_mapper.files.parquet_tiles import split_map
from surfel_mapper.messages.compressed_image import unpacked
from surfel_mapper.messages.pointcloud2 import parse_cloud
from test import extras
from test.fuzz import corpus
from test.offline import dataset_folders

MESSAGE = f"{VARIABLE}: '4G', expected a positive number of bytes, such as 4294967296"

INPUTS = {
    'a.mcap': (corpus.mcap, 'info'),
    'a.db3': (corpus.sqlite, 'info'),
    'a.bag': (corpus.ros1, 'info'),
    'in/a.ply': (corpus.points_ply, 'replay'),
    'in/a.pcd': (corpus.points_pcd, 'replay'),
    'in/a.bin': (corpus.points_raw, 'replay'),
    'a.ply': (corpus.points_ply, 'evaluate'),
    'a.npz': (corpus.state_bytes, 'evaluate'),
    'a.parquet': (corpus.parquet, 'evaluate'),
    'a.txt': (corpus.trajectory, 'evaluate'),
    'a.laz': (corpus.las, 'filter'),
}


@pytest.fixture
def wrong(monkeypatch):
    monkeypatch.setenv(VARIABLE, '4G')


def refusal(capsys, verb, *arguments):
    """Return the only line that a verb prints, which refuses its work."""
    assert main([verb, *map(str, arguments)]) == 1
    out, err = capsys.readouterr()
    assert out == ''
    (line,) = err.splitlines()
    return line.removeprefix(f'surfel-mapper {verb}: ')


@pytest.mark.parametrize('name', INPUTS)
def test_the_verb_ends_with_the_message(tmp_path, monkeypatch, capsys, name):
    if name.endswith('.parquet'):
        extras.load('pyarrow')
    if name.endswith('.laz'):
        pytest.importorskip('laspy')
    make, verb = INPUTS[name]
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(make()[0])
    (tmp_path / 'chain.yaml').write_text('- range_limit: {min_m: 1}\n')
    arguments = {
        'info': [path],
        'replay': [path.parent, '--output', tmp_path / 'out'],
        'evaluate': [path, '--truth', path],
        'filter': [tmp_path / 'chain.yaml', path, '--output', tmp_path / 'out.ply'],
    }
    monkeypatch.setenv(VARIABLE, '4G')
    assert refusal(capsys, verb, *arguments[verb]) == MESSAGE
    assert not (tmp_path / 'out').exists()


def test_a_data_set_ends_with_the_message(tmp_path, wrong, capsys):
    dataset_folders.nuscenes(tmp_path / 'in')
    assert refusal(capsys, 'info', tmp_path / 'in') == MESSAGE


def test_a_tile_is_not_taken_for_damaged(tmp_path, wrong):
    extras.load('pyarrow')
    (tmp_path / 'a.parquet').write_bytes(corpus.parquet()[0])
    with pytest.raises(ConfigError, match='4G'):
        next(split_map(tmp_path / 'a.parquet'))


def test_a_cloud_is_not_taken_for_damaged(wrong):
    with pytest.raises(ConfigError, match='4G'):
        parse_cloud(corpus.clouds()[0][1:])


def test_an_image_is_not_taken_for_damaged(wrong):
    png = corpus.packed_images()[3][1:]
    message = SimpleNamespace(header=None, format='rgb8; png compressed', data=png)
    with pytest.raises(ConfigError, match='4G'):
        unpacked(message, '/image', exact=True)
