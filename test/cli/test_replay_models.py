# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper replay`` with models: the files agree with each other, and with the scene."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from test import extras
from test.bags.recorded import drive, HEIGHT_M, MOUNT_M, write_rosbag2
from test.viz.test_report import Parsed

FORMATS = 'ply,parquet,dxf'


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_rosbag2(tmp_path_factory.mktemp('bags') / 'drive', drive())


@pytest.fixture(scope='module')
def output(bag, tmp_path_factory):
    """Return the output directory of a replay with models."""
    extras.load('ezdxf')
    extras.load('pyarrow')
    extras.load('rerun')
    output = tmp_path_factory.mktemp('out') / 'map'
    output.parent.joinpath('a.yaml').write_text('layers: {models: {enabled: true}}\n')
    config = ['--config', str(output.with_name('a.yaml')), '--rrd', str(output.with_name('a.rrd'))]
    assert main(['replay', str(bag), '--formats', FORMATS, '--output', str(output), *config]) == 0
    return output


def test_the_floor_and_the_wall_are_planes_where_they_are(output):
    planes = json.loads((output / 'models.json').read_text())['planes']
    largest = sorted(planes, key=lambda plane: -plane['num_points'])[:2]
    assert np.abs([plane['normal'] for plane in largest]) == pytest.approx(
        np.eye(3)[[2, 1]], abs=1e-6
    )
    sensor = np.array([0.0, 0.0, HEIGHT_M]) + MOUNT_M
    floor, wall = (plane['normal'] @ np.array(plane['mean']) for plane in largest)
    assert abs(floor) == pytest.approx(abs(sensor[2] - 1.0), abs=1e-5)
    assert abs(wall) == pytest.approx(abs(sensor[1] + 3.1), abs=1e-5)


def test_summary_json_and_parquet_agree_to_the_end_of_the_recording(output):
    from pyarrow import parquet

    summary = json.loads((output / 'summary.json').read_text())['models']
    found = json.loads((output / 'models.json').read_text())
    for kind in ('planes', 'surfaces', 'gaussians'):
        assert summary[kind] == len(found[kind])
    primitives = [*found['planes'], *found['surfaces'], *found['gaussians']]
    rows = parquet.read_table(output / 'models.parquet').to_pydict()
    for name in ('id', 'version', 'num_points'):
        assert rows[name] == [primitive[name] for primitive in primitives]
    names = (output / 'models.obj').read_text().splitlines()
    expected = [f'o plane_{plane["id"]}' for plane in found['planes']]
    assert [name for name in names if name.startswith('o plane')] == expected


def test_the_drawing_has_an_outline_for_every_ring(output):
    import ezdxf

    found = json.loads((output / 'models.json').read_text())
    lines = ezdxf.readfile(output / 'models.dxf').modelspace().query('POLYLINE')
    rings = [ring for kind in ('planes', 'surfaces') for p in found[kind] for ring in p['outline']]
    assert [line.is_closed for line in lines] == [True] * len(rings)


def test_report_picture_and_recording_show_them(output):
    parsed = Parsed((output / 'report.html').read_text(encoding='utf-8'))
    assert [text for tag, _, text in parsed.text if tag == 'option'][:2] == ['surfels', 'models']
    assert 'Planes, surfaces, Gaussians' in [text for tag, _, text in parsed.text if tag == 'h2']
    assert (output / 'models.png').stat().st_size > 10_000
    command = [sys.executable, '-m', 'rerun', 'rrd', 'print', str(output.with_name('a.rrd'))]
    printed = subprocess.run(command, capture_output=True, text=True).stdout
    for entity in ('patches', 'outlines', 'gaussians'):
        assert f'/map/models/{entity}' in printed


def test_a_drawing_is_refused_without_models(bag, tmp_path, capsys):
    arguments = ['replay', str(bag), '--formats', 'dxf', '--output', str(tmp_path / 'out')]
    assert main(arguments) == 1
    assert 'layers.models.enabled' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()
