# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The same bag gives the same map: in any process, with threads, without the compiler.

``DIGEST`` was found with Python integers (``test.reference``), and holds for every machine and
Python: ``make versions`` runs this file with each that it finds. Points and poses are made of
whole numbers alone, so that nothing depends on a library of mathematics.
"""

import json
import os
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest

from surfel_mapper.bags.writer import BagWriter
from surfel_mapper.cli.main import main
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.messages.pointcloud2 import from_columns
from surfel_mapper.messages.poses import StampedPose
from test import reference

pytestmark = pytest.mark.usefixtures('undrawn')

DIGEST = 'e69318006b4cc88421b44993a531f439ca2c576e109dad5844bad84641b92a40'

NUM_SCANS = 8
WINDOW = 5
QUATERNIONS = ((0.0, 0.0, 0.6, 0.8), (0.5, 0.5, -0.5, 0.5), (0.0, 0.28, 0.0, 0.96))

UNDRAWN = """
import sys
from surfel_mapper.cli.main import main
from surfel_mapper.offline import outputs

outputs.draw_map = outputs.write_report = lambda *_, **__: None
sys.exit(main(sys.argv[1:]))
"""
"""The command without its pictures, which take 36 of 39 s without the compiler."""

SETTINGS = {'pose.source': 'odometry', 'window.max_scans': WINDOW, 'input.max_range_m': 11.0}


def drive():
    """Yield stamp, position, orientation and points of every scan."""
    for number in range(NUM_SCANS):
        mixed = (np.arange(1200, dtype=np.uint64) + np.uint64(7919 * number)) * np.uint64(
            0x9E3779B97F4A7C15
        )
        lattice = (mixed >> np.uint64(40)).astype(np.int64).reshape(-1, 3)
        points = ((lattice % 20011 - 10005) / 1024).astype(np.float32)
        points[:, 2] = (lattice[:, 2] % 5 / 64).astype(np.float32)
        points[::97] = np.nan
        xyz = (1e4 + number / 4, -number / 8, 0.5)
        yield (number + 1) * 10**8, xyz, QUATERNIONS[number % 3], points


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp('bag') / 'whole_numbers'
    with BagWriter(path) as writer:
        for stamp_ns, xyz, q_xyzw, points in drive():
            pose = StampedPose('odom', 'base_link', stamp_ns, xyz, q_xyzw)
            writer.write_odometry('/odom', stamp_ns, pose)
            cloud = from_columns(dict(zip('xyz', points.T, strict=True)))
            writer.write_cloud('/points', stamp_ns, stamp_ns, 'base_link', cloud)
    return path


def replayed(bag, directory, *, interpreted=False, **settings):
    """Return the digest that replay states; interpreted it needs a process of its own."""
    config = directory / 'config.yaml'
    config.write_text(json.dumps({**SETTINGS, **settings}))
    command = ['replay', bag, '--window', '--config', config, '--output', directory / 'map']
    command.append('--overwrite')
    command = [*map(str, command)]
    if interpreted:
        done = subprocess.run(
            [sys.executable, '-c', UNDRAWN, *command],
            cwd=Path(__file__).parents[1],
            env={**os.environ, 'NUMBA_DISABLE_JIT': '1'},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    else:
        assert main(command) == 0
    summary = json.loads((directory / 'map' / 'summary.json').read_text())
    assert summary['scans']['mapped'] == NUM_SCANS
    return summary['digest']


def test_the_digest_is_that_of_python_integers():
    moments = {}
    for _, xyz, q_xyzw, points in list(drive())[-WINDOW:]:
        pose = pose_matrix(xyz, q_xyzw)
        ranges_sq = (points.astype(np.float64) ** 2).sum(axis=1)
        points = points[(ranges_sq >= 0.1**2) & (ranges_sq <= 11.0**2)]
        reference.add_moments(moments, reference.scan_moments(points, 0.5, pose[:3, 3], pose))
    assert reference.digest(moments, 0.5) == DIGEST


@pytest.mark.parametrize('how', [{}, {'interpreted': True}], ids=str)
def test_every_way_to_run_gives_the_digest(bag, tmp_path, how):
    assert replayed(bag, tmp_path, **how) == DIGEST
