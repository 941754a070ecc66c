# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Progress is a bar on a terminal, else lines; after Ctrl-C the scans so far are written."""

import json
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from surfel_mapper.cli import _progress as progress_module
from surfel_mapper.cli._progress import progress, stopped_by_interrupt
from surfel_mapper.cli.main import main
from surfel_mapper.files.map_state import load_map
from surfel_mapper.viz import picture
from test.bags.recorded import drive, Entries, PERIOD_NS, START_NS, write_rosbag2

pytestmark = pytest.mark.usefixtures('undrawn')

MANY = 5000
WAIT_S = 300.0
WITH_MANY_LINES = """
import sys
from surfel_mapper.cli import _progress, main
_progress.EVERY_S = 0.02
sys.exit(main.main())
"""


def test_lines_state_progress_rate_and_time_left(monkeypatch, capsys):
    monkeypatch.setattr(progress_module, 'EVERY_S', 0.0)

    with progress('replay', 'scan') as show:
        show(0, 200)
        time.sleep(0.01)
        show(50, 200)

    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('surfel-mapper replay: 50 of 200 scans, ')
    assert line.endswith(' s left')


def test_no_line_comes_in_the_first_seconds(capsys):
    with progress('replay', 'scan') as show:
        show(50, 200)

    assert capsys.readouterr().err == ''


def test_the_first_interrupt_is_reported_and_the_second_interrupts():
    before = signal.getsignal(signal.SIGINT)
    with stopped_by_interrupt() as stopped:
        assert not stopped()
        signal.raise_signal(signal.SIGINT)
        assert stopped()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.drawn
def test_ctrl_c_while_files_are_written_leaves_all_of_them(tmp_path, monkeypatch, capsys):
    draw, pressed = picture.draw_map, []

    def pressing(*args, **options):
        pressed.append(signal.raise_signal(signal.SIGINT))
        draw(*args, **options)

    monkeypatch.setattr(picture, 'draw_map', pressing)
    bag = write_rosbag2(tmp_path / 'bag', drive())

    assert main(['replay', str(bag), '--output', str(tmp_path / 'out'), '--json']) == 130

    assert len(pressed) == 1
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text(encoding='utf-8'))
    assert summary == json.loads(capsys.readouterr().out)
    assert {path.name for path in (tmp_path / 'out').iterdir()} == {
        'map.npz',
        'map.ply',
        'map.png',
        'report.html',
        'scans.csv',
        'summary.json',
        'trajectory.tum',
    }


@pytest.fixture(scope='module')
def long_bag(tmp_path_factory):
    """Return a bag that takes some seconds to map."""
    entries = Entries()
    points = np.random.default_rng(1).uniform(-20.0, 20.0, (500, 3))
    for i in range(MANY):
        entries.cloud('/points', START_NS + i * PERIOD_NS, points)
    return write_rosbag2(tmp_path_factory.mktemp('bags') / 'long', entries)


@pytest.fixture
def command(long_bag, tmp_path):
    settings = tmp_path / 'settings.yaml'
    settings.write_text('pose: {source: identity}\n')
    options = ['--config', str(settings), '--formats', 'npz,bag', '--json']
    program = [sys.executable, '-c', WITH_MANY_LINES, 'replay', str(long_bag)]
    return [*program, *options, '--output', str(tmp_path / 'out')]


def test_sigterm_ends_a_replay_early_and_the_map_is_written(command, tmp_path):
    pipes = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE}
    with subprocess.Popen(command, **pipes) as process:
        assert any(map(is_underway, process.stderr))
        process.send_signal(signal.SIGTERM)
        printed, said = process.communicate(timeout=WAIT_S)

    assert process.returncode == 130, said
    summary = json.loads(printed)
    assert summary['interrupted']
    assert 0 < summary['scans']['mapped'] < MANY
    assert load_map(tmp_path / 'out')[0].digest() == summary['digest']


def is_underway(shown):
    """Return whether the progress shown counts some scans."""
    return re.search(rb'\b[1-9]\d*(/| of )%d' % MANY, shown) is not None
