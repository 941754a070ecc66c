# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``--set`` and ``--voxel-size`` change settings, override the file, and are checked like it."""

import json

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.files import ply
from test import extras
from test.bags.recorded import drive, write_rosbag2

pytestmark = pytest.mark.usefixtures('undrawn')


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_rosbag2(tmp_path_factory.mktemp('bags') / 'drive', drive())


def settings_of(tmp_path, bag, *options):
    """Return the settings of a replay with some options."""
    output = tmp_path / 'out'
    assert main(['replay', str(bag), '--output', str(output), '--every', '3', *options]) == 0
    return json.loads((output / 'summary.json').read_text())['settings']


def refusal(capsys, *arguments):
    """Return the message with which a command is refused."""
    assert main(arguments) == 1
    return capsys.readouterr().err.strip()


def test_options_override_the_file(bag, tmp_path):
    config = tmp_path / 'my.yaml'
    config.write_text('map: {voxel_size_m: 1.0, min_points: 7}\nframes: {base: base_link}\n')

    options = ['--voxel-size', '0.25', '--set', 'map.min_points=9', '--config', str(config)]
    settings = settings_of(tmp_path, bag, *options)

    assert settings['map.voxel_size_m'] == 0.25
    assert settings['map.min_points'] == 9
    assert settings['frames.base'] == 'base_link'


def test_values_are_read_as_yaml(bag, tmp_path):
    values = {
        'window.keep_points=true': True,
        'registration.noise_m=5e-2': 0.05,
        'frames.base_to_sensor=[0, 0, 2, 0, 0, 0, 1]': [0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0],
        'map.origin="0 0 1"': '0 0 1',
        'pose.max_wait_s=1': 1.0,
    }
    options = [word for assignment in values for word in ('--set', assignment)]

    settings = settings_of(tmp_path, bag, *options)

    for assignment, value in values.items():
        assert settings[assignment.partition('=')[0]] == value


def test_the_last_of_two_options_for_a_setting_counts(bag, tmp_path):
    first = ['--set', 'map.voxel_size_m=2', '--voxel-size', '0.4']
    assert settings_of(tmp_path, bag, *first)['map.voxel_size_m'] == 0.4


@pytest.mark.parametrize('verb', ['replay', 'filter', 'view'])
def test_an_unknown_name_is_refused_with_the_nearest(bag, tmp_path, capsys, verb):
    extras.load('rerun')
    (tmp_path / 'chain.yaml').write_text('- remove_nan\n')
    words = {
        'replay': [str(bag), '--output', str(tmp_path / 'out')],
        'filter': [str(tmp_path / 'chain.yaml'), str(bag), '--output', str(tmp_path / 'out')],
        'view': [str(bag), '--rrd', str(tmp_path / 'a.rrd')],
    }
    said = refusal(capsys, verb, *words[verb], '--set', 'frames.bse=robot')
    assert said == f'surfel-mapper {verb}: frames.bse: no such setting; did you mean frames.base?'


@pytest.mark.parametrize('text', ['map.min_points', '=3', 'map.min_points=[1', 'a={b: 1, b: 2}'])
def test_a_text_that_is_no_assignment_is_wrong_usage(capsys, text):
    with pytest.raises(SystemExit) as stopped:
        main(['replay', 'a', '--set', text])
    assert stopped.value.code == 2
    assert f'argument --set: {text!r}' in capsys.readouterr().err


def test_the_mount_of_a_filtered_cloud_can_be_set(tmp_path, capsys):
    points = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -2.0]])
    ply.write_points(tmp_path / 'in.ply', {name: points[:, k] for k, name in enumerate('xyz')})
    (tmp_path / 'chain.yaml').write_text('- bounding_box: {z_min_m: -1.0}\n')
    command = ['filter', str(tmp_path / 'chain.yaml'), str(tmp_path / 'in.ply')]

    mount = ['--set', 'frames.base_to_sensor=[0, 0, 1]']
    said = refusal(capsys, *command, '-o', str(tmp_path / 'out.ply'), *mount)

    assert 'frames.base_to_sensor' in said


def test_settings_are_refused_where_nothing_is_mapped(tmp_path, capsys):
    ply.write_points(tmp_path / 'a.ply', dict.fromkeys('xyz', np.zeros(3)))
    assert main(['view', str(tmp_path / 'a.ply'), '--voxel-size', '0.2']) == 2
    assert '--voxel-size: expected a recording' in capsys.readouterr().err
