# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A replay with poses in UTM: every file has UTM coordinates, and the verbs go on with them."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from surfel_mapper import replay
from surfel_mapper.cli.main import main
from surfel_mapper.cluster.replay import replay_bags
from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError
from surfel_mapper.evaluation.map_files import load_discs
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.trajectory import read_trajectory, write_tum
from surfel_mapper.offline.replay import ReplayOptions
from surfel_mapper.offline.request import Request
from test import extras
from test.bags.recorded import drive, HEIGHT_M, NUM_SCANS, PERIOD_NS, START_NS, write_rosbag2

UTM = np.array([400_000.0, 5_400_000.0, 250.0])
FLOAT_M = 1e-6  # float32 rounds coordinates up to 16 m by less

SETTINGS = {
    'frames.base_to_sensor': (0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0),
    'layers.tsdf.enabled': True,
    'layers.models.enabled': True,
}


FORMATS = ('ply', 'pcd', 'npz', *(['parquet'] if extras.has('pyarrow') else []))


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_rosbag2(tmp_path_factory.mktemp('bags') / 'drive', drive())


def replayed(bag, directory, origin, shift):
    """Replay the drive at poses that are shifted, from a file."""
    directory.mkdir()
    poses = np.tile(np.eye(4), (NUM_SCANS, 1, 1))
    poses[:, :3, 3] = [shift + np.array([0.5 * i, 0.0, HEIGHT_M]) for i in range(NUM_SCANS)]
    stamps_ns = [START_NS + i * PERIOD_NS for i in range(NUM_SCANS)]
    write_tum(directory / 'poses.tum', stamps_ns, poses)
    return replay(
        Request(path=bag, topics=('/points',), poses=directory / 'poses.tum'),
        output=directory / 'out',
        config=Config.from_mapping({**SETTINGS, 'map.origin': origin}),
        options=ReplayOptions(formats=FORMATS, truth=directory / 'poses.tum'),
    )


@pytest.fixture(scope='module')
def near(bag, tmp_path_factory):
    return replayed(bag, tmp_path_factory.mktemp('runs') / 'near', '', np.zeros(3))


@pytest.fixture(scope='module')
def far(bag, tmp_path_factory):
    return replayed(bag, tmp_path_factory.mktemp('runs') / 'far', '400000 5400000 250', UTM)


def out_of(result):
    return result.written[0].parent


def points_of(columns):
    return np.stack([columns[axis].astype(np.float64) for axis in 'xyz'], axis=1)


def test_the_map_is_that_of_the_shifted_poses(near, far):
    assert far.summary['digest'] == near.summary['digest']
    assert far.summary['origin_m'] == UTM.tolist()
    assert near.summary['origin_m'] == [0.0, 0.0, 0.0]


def test_every_file_has_the_coordinates_of_the_poses(near, far):
    for name, atol in (('map.ply', FLOAT_M), ('mesh.ply', 0.0)):
        expected, found = (points_of(ply.read_points(out_of(run) / name)) for run in (near, far))
        np.testing.assert_allclose(found, expected + UTM, rtol=0, atol=atol)
    found = points_of(pcd.read_points(out_of(far) / 'map.pcd'))
    np.testing.assert_array_equal(found, points_of(ply.read_points(out_of(far) / 'map.ply')))
    trajectory = read_trajectory(out_of(far) / 'trajectory.tum')
    expected = read_trajectory(out_of(near) / 'trajectory.tum')
    np.testing.assert_allclose(trajectory.xyz, expected.xyz + UTM, rtol=0, atol=1e-9)
    models = [json.loads((out_of(run) / 'models.json').read_text()) for run in (near, far)]
    assert models[0]['planes']
    for one, other in zip(models[0]['planes'], models[1]['planes'], strict=True):
        np.testing.assert_allclose(other['mean'], np.array(one['mean']) + UTM, atol=1e-9)
        np.testing.assert_allclose(other['outline'][0], one['outline'][0] + UTM, atol=1e-6)
        assert np.dot(other['normal'], other['mean']) + other['offset_m'] == pytest.approx(0.0)
    for run in (near, far):
        assert run.summary['pose_errors']['absolute']['translation_m']['max'] < 1e-6


def test_the_report_states_positions_and_the_origin_in_the_fixed_frame(near, far):
    pages = [(out_of(run) / 'report.html').read_text() for run in (near, far)]

    assert 'origin of the map</dt><dd>400000, 5400000, 250 m<' in pages[1]
    assert 'origin of the map' not in pages[0]
    data = [json.loads(re.search('id="map">(.*?)</script>', text)[1]) for text in pages]
    expected, found = (np.array(view['middle']) for view in data)
    np.testing.assert_allclose(found, expected + UTM, rtol=0, atol=1e-6)


@pytest.mark.parametrize('name', ['map.npz', 'map.parquet', 'map.ply', '.'])
def test_maps_are_compared_in_outer_coordinates(near, far, name):
    if name.endswith('parquet'):
        extras.load('pyarrow')
    expected, found = (load_discs(out_of(run) / name, 5) for run in (near, far))

    def order(places):
        return places[np.lexsort(np.round(places.T, 3))]

    np.testing.assert_allclose(
        order(found.position - UTM),
        order(expected.position),
        rtol=0,
        atol=FLOAT_M if name == 'map.ply' else 2e-9,
    )


def test_models_are_extracted_in_outer_coordinates(far, tmp_path):
    viewpoint = [str(value) for value in UTM + np.array([0, 0, 2])]
    command = ['extract', str(out_of(far)), '--output', str(tmp_path), '--viewpoint', *viewpoint]

    assert main(command) == 0

    content = json.loads((tmp_path / 'models.json').read_text())
    means = np.array([plane['mean'] for plane in content['planes']])
    assert len(means)
    assert (np.abs(means - UTM) < 20.0).all()


def test_auto_with_workers_is_refused_before_the_work(bag, tmp_path):
    config = Config.from_mapping({'map.origin': 'auto'})
    with pytest.raises(ConfigError, match=r'map\.origin: auto, expected x y z'):
        replay_bags([Request(path=bag)], config, tmp_path)
