# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Every example runs as from the command line, and its output is true.

The output is compared with the command line, with another computation of the number, or with the
content of the written file.
"""

from __future__ import annotations

import ast
import contextlib
import json
import os
from pathlib import Path
import re
import runpy
import subprocess
import sys

import numpy as np
from PIL import Image
import pytest
import yaml

from surfel_mapper.cli.main import main
from surfel_mapper.files.map_state import save_map
from surfel_mapper.files.ply import read_points
from surfel_mapper.mapping.surfel_map import SurfelMap
from test import extras
from test.ros.domain import domain_of_our_own

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / 'examples'


@pytest.fixture
def run(capsys, monkeypatch):
    """Return a function that runs an example in a folder and returns its output."""

    def run(name, *arguments, folder):
        with monkeypatch.context() as patch:
            patch.chdir(folder)
            patch.setattr(sys, 'argv', [str(EXAMPLES / name), *map(str, arguments)])
            capsys.readouterr()
            with contextlib.suppress(SystemExit):
                runpy.run_path(sys.argv[0], run_name='__main__')
        return capsys.readouterr().out

    return run


def run_process(name, *arguments, folder):
    """Run an example in a folder as a process of its own; return its output."""
    done = subprocess.run(
        [sys.executable, EXAMPLES / name, *map(str, arguments)],
        cwd=folder,
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_demo_without_ros_leaves_out_the_node_and_says_so(run, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, 'rclpy', None)
    monkeypatch.setenv('PYTHONPATH', str(ROOT))
    opened = []
    monkeypatch.setattr('webbrowser.open', opened.append)
    small = ('--scans', 4, '--beams', 16, '--columns', 256)
    out = run('demo.py', *small, '--open', folder=tmp_path)

    assert 'The live node is left out: ROS 2 is not installed' in out
    assert out.splitlines()[-1] == 'picture  demo/offline/map.png'
    assert opened == [(tmp_path / 'demo' / 'offline' / 'report.html').as_uri()]
    summary = json.loads((tmp_path / 'demo' / 'offline' / 'summary.json').read_text('utf-8'))
    assert summary['scans']['mapped'] == 4
    assert Image.open(tmp_path / 'demo' / 'offline' / 'map.png').size[0] > 500


def test_the_demo_claims_a_domain_that_no_test_holds(capsys):
    own_domain = runpy.run_path(str(EXAMPLES / 'demo.py'))['own_domain']
    with domain_of_our_own():  # and the environment as it was, at the end
        domains = [os.environ['ROS_DOMAIN_ID']]
        with own_domain():
            domains.append(os.environ['ROS_DOMAIN_ID'])
            with own_domain():
                domains.append(os.environ['ROS_DOMAIN_ID'])
    assert len(set(domains)) == 3
    assert f'ROS domain {domains[1]}, on this machine only' in capsys.readouterr().out


@pytest.fixture(scope='module')
def street(tmp_path_factory):
    """Return a folder with the bag of a short drive, and its map."""
    folder = tmp_path_factory.mktemp('street')
    lidar = ['--scans', '20', '--beams', '16', '--columns', '360']
    assert main(['simulate', 'street', '--output', str(folder / 'bag'), *lidar]) == 0
    formats = ['--formats', 'ply,npz', '--output', str(folder / 'mapped')]
    assert main(['replay', str(folder / 'bag'), *formats]) == 0
    return folder


def digest_of(folder):
    return json.loads((folder / 'summary.json').read_text(encoding='utf-8'))['digest']


def test_every_example_says_in_its_first_lines_how_it_is_run():
    examples = sorted(EXAMPLES.glob('*.py'))
    assert len(examples) >= 6
    for path in examples:
        doc = ast.get_docstring(ast.parse(path.read_text(encoding='utf-8')))
        assert f'examples/{path.name}' in doc or 'make demo' in doc


@pytest.mark.parametrize(
    'name', sorted({p.name for p in EXAMPLES.glob('*.py')} - {'ten_lines.py'})
)
def test_help_prints_the_usage_and_writes_nothing(tmp_path, run, name):
    if name in ('mirror_map.py', 'subscribe.py'):
        pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
    printed = run(name, '--help', folder=tmp_path)
    assert printed.startswith(f'usage: {name} [-h]')
    assert not [*tmp_path.iterdir()]


def test_ten_lines_give_the_map_of_the_last_ten_scans(tmp_path, run):
    printed = run('ten_lines.py', folder=tmp_path)
    assert re.match(r'\d{4} surfels, \d{3,4} of them good and level\n', printed)
    assert printed.endswith('equal to a map of these alone: True\n')


def test_slope_costs_are_a_map_that_nav2_reads(street, tmp_path, run):
    run('slope_costs.py', street / 'mapped/map.npz', 'costs', '--max-slope', 20, folder=tmp_path)

    place = yaml.safe_load((tmp_path / 'costs.yaml').read_text(encoding='utf-8'))
    content = (tmp_path / place['image']).read_bytes()
    kind, columns, rows, most = content[: content.index(b'255\n') + 3].split()
    image = np.frombuffer(content[-int(rows) * int(columns) :], np.uint8)
    assert (kind, most, place['mode']) == (b'P5', b'255', 'raw')
    assert set(np.unique(image[image > 100])) == {255}
    assert image.min() < 50  # the street climbs
    assert (image == 100).any()


def test_slope_costs_have_level_ground_free_and_a_wall_blocked_where_they_are(tmp_path, run):
    rng = np.random.default_rng(1)
    ground = rng.uniform([0.0, 0.0, 0.1], [10.0, 6.0, 0.12], (20000, 3))
    wall = rng.uniform([4.1, 0.0, 0.1], [4.12, 6.0, 2.0], (20000, 3))
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.concatenate([ground, wall]))
    save_map(tmp_path / 'map.npz', surfel_map)

    run('slope_costs.py', 'map.npz', 'costs', folder=tmp_path)

    place = yaml.safe_load((tmp_path / 'costs.yaml').read_text(encoding='utf-8'))
    content = (tmp_path / 'costs.pgm').read_bytes()
    columns = int(content.split()[1])
    image = np.frombuffer(content[-columns * columns :], np.uint8).reshape(columns, columns)

    def cost(x, y):
        column, row = ((np.array([x, y]) - place['origin'][:2]) / place['resolution']).astype(int)
        return image[columns - 1 - row, column]

    assert cost(1.25, 3.25) < 10
    assert cost(8.25, 3.25) < 10
    assert cost(4.25, 3.25) == 100
    assert cost(1.25, 7.25) == 255


def test_equal_maps_compare_as_equal(street, tmp_path, run):
    map_file = street / 'mapped/map.npz'
    printed = run('compare_maps.py', map_file, map_file, folder=tmp_path)
    assert printed == f'equal to the bit: {digest_of(street / "mapped")}\n'


def test_differences_between_two_maps_are_counted_and_written(tmp_path, run):
    rng = np.random.default_rng(2)
    before, after = SurfelMap(0.5), SurfelMap(0.5)
    stays, goes, comes = (rng.uniform(low, low + 0.5, (50, 3)) for low in (0.0, 2.0, 4.0))
    for surfel_map, points in ((before, goes), (after, comes)):
        surfel_map.add(stays)
        surfel_map.add(points)
    save_map(tmp_path / 'before.npz', before)
    save_map(tmp_path / 'after.npz', after)

    printed = run(
        'compare_maps.py', 'before.npz', 'after.npz', '--output', 'new.ply', folder=tmp_path
    )

    assert '1 surfel came, 1 went, 0 turned; voxels with one in both: 1' in printed
    written = read_points(tmp_path / 'new.ply')
    assert [written['x'][0], len(written['x'])] == [pytest.approx(comes[:, 0].mean()), 1]


def test_a_dask_run_comes_to_the_digest_of_a_single_process(street, tmp_path):
    extras.load('distributed')
    arguments = ['--output', 'city', '--workers', 2, '--shard', 1]
    printed = run_process('dask_run.py', street / 'bag', *arguments, folder=tmp_path)
    assert printed.startswith('2 shards')
    assert f'digest {digest_of(street / "mapped")}' in printed


@pytest.mark.parametrize('name', ['drive_animation', 'filter_picture'])
def test_examples_that_draw_explain_their_arguments(name, tmp_path, run):
    text = run(f'{name}.py', '--help', folder=tmp_path)
    assert text.startswith(f'usage: {name}.py [-h] path')
    assert 'picture to write' in text
    assert not list(tmp_path.iterdir())


def test_the_animation_of_a_drive_has_a_frame_a_scan_and_moves(tmp_path, run):
    text = run('drive_animation.py', 'drive.webp', '3', folder=tmp_path)
    assert int(re.search(r': 3 frames, ([\d,]+) surfels', text)[1].replace(',', '')) > 1000
    with Image.open(tmp_path / 'drive.webp') as animation:
        assert (animation.n_frames, animation.info['loop']) == (3, 0)
        frames = []
        for number in range(3):
            animation.seek(number)
            frames.append(np.asarray(animation.convert('RGB'), np.int64))
            assert animation.info['duration'] == 100
    red, green, blue = frames[-1].reshape(-1, 3).T
    assert (blue > red + 30).sum() > 2000  # the road
    assert (red > green + 30).sum() > 2000  # walls
    assert np.abs(frames[2] - frames[0]).mean() > 1.0


def test_the_picture_of_filters_shows_fewer_points_and_ground(tmp_path, run):
    text = run('filter_picture.py', 'filters.png', folder=tmp_path)
    before, after, ground = map(
        int, re.search(r'(\d+) -> (\d+) points, (\d+) ground', text).groups()
    )
    assert 0 < ground < after < before
    assert (tmp_path / 'filters.png').read_bytes().startswith(b'\x89PNG')


def test_the_distance_field_is_meshed_and_has_distances(tmp_path, run):
    said = run('distance_field.py', 'street.ply', folder=tmp_path)
    triangles, near = (float(n) for n in re.findall(r'([\d.]+) (?:triangles|m)\b', said))
    assert triangles > 10_000
    assert 0.2 < near < 3.0
    assert (tmp_path / 'street.ply').stat().st_size > 100_000
