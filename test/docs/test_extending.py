# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A limit of the window that is added by docs/extending.md evicts scans, and a replay lifts it."""

from __future__ import annotations

import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import textwrap

import surfel_mapper
from test.settings import ROOT

DRIVE = """
import json
import math

import numpy as np

from surfel_mapper import Config, Mapper, Scan
from surfel_mapper.offline.replay import configured, ReplayOptions

TURN_DEG, SCANS = 10.0, 20


def drive(config):
    '''Turn on the spot; return the numbers of kept and of evicted scans.'''
    mapper, S = Mapper(config), 10**9
    for number in range(SCANS):
        half = math.radians(number * TURN_DEG) / 2.0
        q_xyzw = (0.0, 0.0, math.sin(half), math.cos(half))
        mapper.add_pose('odom', 'base_link', number * S, (0.0, 0.0, 0.0), q_xyzw)
        points = np.random.default_rng(number).uniform(1.0, 3.0, (40, 3))
        mapper.add_scan(Scan(points=points, stamp_ns=number * S, frame_id='base_link'))
        list(mapper.insert_ready())
    return len(mapper.window), dict(mapper.counters.evicted)


limited = Config().replace(
    {'pose.source': 'odometry', 'window.max_scans': 0, 'window.max_turn_deg': 45.0}
)
options = {'window': {'window': True}, 'all': {}, 'align': {'align': True}}
print(json.dumps({n: drive(configured(limited, ReplayOptions(**o))) for n, o in options.items()}))
"""


def insert_before(path: Path, text: str, place: str) -> None:
    """Insert text in a file before the only line that begins with another one."""
    content = path.read_text(encoding='utf-8')
    assert content.count(f'\n{place}') == 1
    path.write_text(content.replace(f'\n{place}', f'\n{text}\n{place}'), encoding='utf-8')


def test_a_limit_added_by_the_page_evicts_and_is_lifted_by_a_replay_of_all_scans(tmp_path):
    page = (ROOT / 'docs' / 'extending.md').read_text(encoding='utf-8')
    blocks = re.findall('```python\n(.*?)```', page, re.DOTALL)
    setting, row, measure = (text for text in blocks if re.search('max_turn_deg|turned_deg', text))
    package = tmp_path / 'surfel_mapper'
    shutil.copytree(Path(surfel_mapper.__file__).parent, package)
    stages, window = package / 'config' / 'stages.py', package / 'mapping' / 'window.py'
    insert_before(stages, textwrap.indent(setting, '    '), '    keep_points: bool')
    insert_before(window, measure, 'LIMITS: dict')
    insert_before(window, textwrap.indent(row, '    '), "    'max_scans': lambda")

    environment = {**os.environ, 'PYTHONPATH': str(tmp_path)}
    run = subprocess.run(
        [sys.executable, '-c', DRIVE],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    kept = 5  # the newest, and those before it by 10, 20, 30 and 40 deg
    assert json.loads(run.stdout) == {
        'window': [kept, {'max_turn_deg': 20 - kept}],
        'all': [20, {}],
        'align': [20, {}],
    }
