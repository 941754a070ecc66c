# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Options that several verbs share work alike in all of them, and no output is lost in silence."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys

import numpy as np
import pytest

from surfel_mapper.cli.main import main, VERBS
from surfel_mapper.files import ply
from surfel_mapper.files.map_state import save_map
from surfel_mapper.mapping.surfel_map import SurfelMap
from test import extras
from test.bags.recorded import drive, write_rosbag2

pytestmark = pytest.mark.usefixtures('undrawn')

WRITERS = ('replay', 'replay --workers', 'extract', 'filter', 'merge', 'simulate')
"""Verbs that write a directory."""

SMALL = ('simulate', 'street', '--scans', '1', '--beams', '8', '--columns', '64')


@pytest.fixture(scope='module')
def inputs(tmp_path_factory):
    """Return a directory with a bag, a cloud, a map and a chain."""
    folder = tmp_path_factory.mktemp('inputs')
    write_rosbag2(folder / 'drive', drive())
    rng = np.random.default_rng(0)
    points = rng.uniform([0, 0, 0], [2, 2, 0.01], (500, 3))
    ply.write_points(folder / 'a.ply', {name: points[:, k] for k, name in enumerate('xyz')})
    surfel_map = SurfelMap(0.5)
    surfel_map.add(points)
    save_map(folder / 'map.npz', surfel_map)
    (folder / 'chain.yaml').write_text('- remove_nan\n')
    return folder


def command(verb, inputs):
    """Return a command that lacks its output."""
    if verb.endswith('--workers'):
        extras.load('distributed')
    if verb == 'merge':
        extras.load('pyarrow')
    return {
        'replay': ['replay', str(inputs / 'drive')],
        'replay --workers': ['replay', str(inputs / 'drive'), '--workers', '1'],
        'extract': ['extract', str(inputs / 'a.ply')],
        'filter': ['filter', str(inputs / 'chain.yaml'), str(inputs / 'drive')],
        'merge': ['merge', str(inputs / 'map.npz')],
        'simulate': list(SMALL),
    }[verb]


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.parametrize('verb', WRITERS)
def test_a_directory_with_files_is_refused_and_stays(inputs, tmp_path, capsys, verb):
    output = tmp_path / 'out'
    output.mkdir()
    (output / 'summary.json').write_text('mine')
    (output / 'metadata.yaml').write_text('mine')

    assert main([*command(verb, inputs), '-o', str(output)]) == 1

    said = capsys.readouterr().err
    assert f'{output}: has files in it; expected a new or empty directory, or --overwrite' in said
    assert contents(output) == {'summary.json': b'mine', 'metadata.yaml': b'mine'}


@pytest.mark.parametrize('verb', WRITERS)
def test_a_new_directory_an_empty_one_and_overwriting_are_accepted(inputs, tmp_path, verb):
    (tmp_path / 'empty').mkdir()
    words = command(verb, inputs)

    assert main([*words, '-o', str(tmp_path / 'empty')]) == 0
    names = {path.name for path in (tmp_path / 'empty').iterdir()}
    assert main([*words, '-o', str(tmp_path / 'empty'), '--overwrite']) == 0

    assert {path.name for path in (tmp_path / 'empty').iterdir()} == names
    assert names


@pytest.mark.parametrize(
    ('words', 'package'),
    [
        (('replay', 'drive', '-o', 'out', '--poses-out', 'file.tum'), ''),
        (('replay', 'drive', '-o', 'out', '--rrd', 'file.rrd'), 'rerun'),
        (('view', 'map.npz', '--rrd', 'file.rrd'), 'rerun'),
        (('filter', 'chain.yaml', 'a.ply', '-o', 'file.ply'), ''),
    ],
)
def test_a_file_is_not_replaced_unasked(inputs, tmp_path, monkeypatch, capsys, words, package):
    if package:
        extras.load(package)
    monkeypatch.chdir(tmp_path)
    file = tmp_path / words[-1]
    file.write_text('mine')
    command = [str(inputs / word) if (inputs / word).exists() else word for word in words]

    assert main(command) == 1
    assert f'{file.name}: exists; expected a new name, or --overwrite' in capsys.readouterr().err
    assert file.read_text() == 'mine'
    assert main([*command, '--overwrite']) == 0
    assert file.read_bytes() != b'mine'


@pytest.mark.parametrize(
    ('verb', 'formats'), [('replay', 'ply, pcd'), ('extract', 'json, parquet')]
)
def test_formats_are_a_list_with_commas(inputs, tmp_path, capsys, verb, formats):
    with pytest.raises(SystemExit):
        main([*command(verb, inputs), '-o', str(tmp_path / 'out'), '--formats', 'parqet'])
    said = capsys.readouterr().err
    assert f"argument --formats: 'parqet', expected some of {formats}, " in said
    assert said.rstrip().endswith('separated by commas, did you mean parquet?')
    with pytest.raises(SystemExit):
        main([verb, '--help'])
    text = ' '.join(capsys.readouterr().out.split())
    assert f'--formats LIST comma-separated, of {formats}, ' in text


@pytest.mark.parametrize('verb', sorted(set(VERBS) - {'node', 'filters', 'compile'}))
def test_verbs_are_quiet_or_verbose_but_not_both(verb, capsys):
    with pytest.raises(SystemExit):
        main([verb, '-qv'])
    assert 'argument -v/--verbose: not allowed with argument -q/--quiet' in capsys.readouterr().err


def test_verbose_logs_steps_and_quiet_none(inputs, tmp_path, caplog, capsys):
    words = [*command('replay', inputs), '--overwrite', '-o', str(tmp_path / 'out')]
    for option, level in (('-q', logging.NOTSET), ('-v', logging.INFO), ('-vv', logging.DEBUG)):
        caplog.clear()
        assert main([*words, option]) == 0
        printed = capsys.readouterr()
        assert logging.getLogger('surfel_mapper').level == level
        assert ('mapped 6 scans in ' in caplog.text) == (option != '-q')
        assert '\nscans 6 ' in printed.out
        assert printed.err == ''


def run(words, **environment):
    """Run a command in a process of its own without a display; return it when it has ended."""
    kept = {key: value for key, value in os.environ.items() if 'DISPLAY' not in key}
    return subprocess.run(
        [sys.executable, '-m', 'surfel_mapper.cli.main', *words],
        env={**kept, **environment},
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize(
    ('verb', 'name'), [('replay', 'report.html'), ('extract', 'models.png'), ('merge', 'map.png')]
)
def test_the_result_is_opened_in_the_browser(inputs, tmp_path, verb, name):
    browser, opened, output = tmp_path / 'browser', tmp_path / 'opened', tmp_path / 'an output'
    browser.write_text(f'#!/bin/sh\necho "$1" > "{opened}"\n')
    browser.chmod(0o755)
    words = [*command(verb, inputs), '--open', '--json', '-o', str(output)]

    done = run(words, BROWSER=f'{browser} %s')

    assert done.returncode == 0, done.stderr
    assert opened.read_text().strip() == (output / name).as_uri()
    assert (output / name).stat().st_size > 0
    assert json.loads(done.stdout)
