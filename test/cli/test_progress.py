# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Progress is a bar on a terminal, else lines; after Ctrl-C the scans so far are written."""

import json
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
from surfel_mapper.offline import outputs
from test.bags.recorded import drive, Entries, PERIOD_NS, START_NS, write_rosbag2

pytestmark = pytest.mark.usefixtures('undrawn')

MANY = 50
SIGTERM_AFTER_TEN = """
import signal, sys
from surfel_mapper.cli import _progress, main

def show(self, done, total):
    if done >= 10:
        signal.raise_signal(signal.SIGTERM)

_progress.Lines.show = show
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
    draw, pressed = outputs.draw_map, []

    def pressing(*args, **options):
        pressed.append(signal.raise_signal(signal.SIGINT))
        draw(*args, **options)

    monkeypatch.setattr(outputs, 'draw_map', pressing)
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


def test_sigterm_ends_a_replay_early_and_the_map_is_written(tmp_path):
    entries = Entries()
    points = np.random.default_rng(1).uniform(-20.0, 20.0, (500, 3))
    for i in range(MANY):
        entries.cloud('/points', START_NS + i * PERIOD_NS, points)
    bag = write_rosbag2(tmp_path / 'long', entries)
    words = ['replay', str(bag), '--poses-from', 'identity', '--formats', 'npz,bag', '--json']
    command = [sys.executable, '-c', SIGTERM_AFTER_TEN, *words, '--output', str(tmp_path / 'out')]

    done = subprocess.run(command, capture_output=True, text=True)

    assert done.returncode == 130, done.stderr
    summary = json.loads(done.stdout)
    assert summary['interrupted']
    assert 10 <= summary['scans']['mapped'] < MANY
    assert load_map(tmp_path / 'out')[0].digest() == summary['digest']
