# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper replay --align`` removes the drift of the odometry from map and poses."""

from __future__ import annotations

import json

import numpy as np
import pytest

from surfel_mapper.bags.writer import BagWriter, StampedPose
from surfel_mapper.cli.main import main
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.geometry import pose_matrix, q_xyzw
from surfel_mapper.simulation.recording import cloud_bytes
from test.alignment.street import drifted, relative_errors, street_scans

pytestmark = pytest.mark.usefixtures('undrawn')

NUM_SCANS = 8


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Return a bag of the street whose odometry drifts, of the lidar itself."""
    path = tmp_path_factory.mktemp('bags') / 'street'
    scans, true = street_scans(30)
    with BagWriter(path, 'mcap') as writer:
        for scan, pose in zip(scans, drifted(true[:NUM_SCANS], 0.02, 0.2), strict=False):
            stamp_ns = scan.stamp_ns
            stamped = StampedPose('odom', 'lidar', stamp_ns, pose[:3, 3], q_xyzw(pose))
            writer.write_odometry('/odom', stamp_ns, stamped)
            writer.write_cloud('/points', stamp_ns + 1, stamp_ns, 'lidar', cloud_bytes(scan, 64))
    return path


@pytest.fixture
def settings(tmp_path):
    path = tmp_path / 'settings.yaml'
    path.write_text('pose: {source: odometry}\nframes: {base: lidar}\n')
    return str(path)


def replayed(bag, settings, tmp_path, *options):
    output = tmp_path / 'out'
    poses = tmp_path / 'poses.tum'
    arguments = ['--config', settings, '--output', str(output), '--poses-out', str(poses)]
    assert main(['replay', str(bag), *arguments, '--overwrite', *options]) == 0
    path = read_trajectory(poses)
    transforms = [pose_matrix(xyz, q) for xyz, q in zip(path.xyz, path.q_xyzw, strict=True)]
    return json.loads((output / 'summary.json').read_text()), np.array(transforms)


def test_map_and_poses_lose_their_drift(bag, settings, tmp_path, capsys):
    _, true = street_scans(30)
    before, drift = replayed(bag, settings, tmp_path)

    after, found = replayed(bag, settings, tmp_path, '--align')

    errors = [relative_errors(path, true[:NUM_SCANS], NUM_SCANS - 1)[0] for path in (drift, found)]
    assert errors[1] < errors[0] / 10.0
    assert after['digest'] != before['digest']
    assert after['points'] == before['points']
    assert after['alignment']['settled']
    assert 'alignment' not in before
    assert after['alignment']['text'] in capsys.readouterr().out


def test_alignment_on_the_way_shows_in_the_poses(bag, settings, tmp_path):
    config = tmp_path / 'every.yaml'
    config.write_text(
        'pose: {source: odometry}\nframes: {base: lidar}\nwindow: {keep_points: true}\n'
        'align: {every_scans: 4}\n'
    )
    _, true = street_scans(30)

    summary, found = replayed(bag, str(config), tmp_path)

    assert summary['milliseconds']['align']['median'] > 0.0
    assert relative_errors(found, true[:NUM_SCANS], NUM_SCANS - 1)[0] < 0.02
