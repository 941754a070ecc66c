# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A capture of packets of an Ouster lidar, written by ouster-sdk, is a recording."""

from importlib.metadata import PackageNotFoundError
import json
import os
from pathlib import Path
import subprocess

import numpy as np
import pytest

from surfel_mapper import Config, replay
from surfel_mapper.cli.main import main
from surfel_mapper.errors import DependencyError, FileFormatError
from surfel_mapper.offline.ouster_pcap import OusterPcap
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.request import Request
from test import extras

pytestmark = pytest.mark.usefixtures('undrawn')

ROOT = Path(__file__).resolve().parents[2]
START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 100_000_000
NUM_SCANS, BEAMS, COLUMNS = 3, 64, 512
LOST, MISSED = 16, 100
"""The first columns of each scan do not arrive; from this one on the highest beam hits nothing."""


def ranges_mm(number):
    rows, columns = np.mgrid[:BEAMS, :COLUMNS]
    ranges = (5000 + 1000 * number + 10 * rows + columns).astype(np.uint32)
    ranges[0, MISSED:] = 0
    return ranges


def points_of(number, info):
    """Return the points by the manual of the lidar: beams that start off the axis, in degrees."""
    rows, columns = np.mgrid[:BEAMS, LOST:COLUMNS]
    ranges = ranges_mm(number)[:, LOST:].astype(float)
    beam = info['beam_intrinsics']
    offset = beam['lidar_origin_to_beam_origin_mm']
    encoder = 2 * np.pi * (1 - columns / COLUMNS)
    azimuth = -np.deg2rad(beam['beam_azimuth_angles'])[rows]
    altitude = np.deg2rad(beam['beam_altitude_angles'])[rows]
    flat = (ranges - offset) * np.cos(altitude)
    in_lidar = np.stack(
        [
            flat * np.cos(encoder + azimuth) + offset * np.cos(encoder),
            flat * np.sin(encoder + azimuth) + offset * np.sin(encoder),
            (ranges - offset) * np.sin(altitude),
        ],
        axis=-1,
    )
    T_sensor_lidar = np.reshape(info['lidar_intrinsics']['lidar_to_sensor_transform'], (4, 4))
    in_sensor = in_lidar @ T_sensor_lidar[:3, :3].T + T_sensor_lidar[:3, 3]
    return in_sensor[ranges > 0] / 1e3


@pytest.fixture(scope='module')
def capture(tmp_path_factory):
    core = extras.load('ouster.sdk.core')
    pcap = extras.load('ouster.sdk.pcap')
    info = core.SensorInfo.from_default(core.LidarMode('512x10'))
    info.format.udp_profile_lidar = core.UDPProfileLidar.RNG19_RFL8_SIG16_NIR16
    info.config.udp_port_lidar, info.config.udp_port_imu = 7502, 7503
    packets = []
    for number in range(NUM_SCANS):
        frame = core.LidarFrame(info)
        frame.frame_id = number
        frame.field('RANGE')[:] = ranges_mm(number)
        frame.field('SIGNAL')[:] = 7
        frame.measurement_id[:] = np.arange(COLUMNS)
        times_ns = np.arange(COLUMNS) * PERIOD_NS // COLUMNS
        frame.timestamp[:] = START_NS + number * PERIOD_NS + times_ns
        frame.packet_timestamp[:] = frame.timestamp[:: COLUMNS // len(frame.packet_timestamp)]
        frame.status[:] = np.arange(COLUMNS) >= LOST
        packets += core.frame_to_packets(frame, core.PacketFormat(info), 0, 0)
    path = tmp_path_factory.mktemp('capture') / 'drive.pcap'
    pcap.record(packets, str(path))
    path.with_suffix('.json').write_text(info.to_json_string())
    return path


def test_points_are_those_of_the_manual_with_beams_and_times(capture):
    info = json.loads(capture.with_suffix('.json').read_text())
    found = OusterPcap(capture)

    assert found.stamps_ns == [START_NS + number * PERIOD_NS for number in range(NUM_SCANS)]
    for number in range(NUM_SCANS):
        points, columns = found.scan(number)
        np.testing.assert_allclose(points, points_of(number, info), atol=1e-5)
        rows, at = np.nonzero(ranges_mm(number)[:, LOST:])
        assert columns['ring'].tolist() == rows.tolist()
        # fractions of a ns are lost twice
        np.testing.assert_allclose(columns['t'], at * PERIOD_NS / COLUMNS, atol=2)
        assert set(columns['intensity'].tolist()) == {7.0}


def test_the_release_of_the_extra_reads_the_same(capture, tmp_path):
    python = os.environ.get('SURFEL_MAPPER_OUSTER_PYTHON')
    if not python:
        pytest.skip('`make ouster` runs this, with an environment that has the extra `ouster`')
    read = (
        'from pathlib import Path\nimport sys\nimport numpy as np\n'
        'from surfel_mapper.offline.ouster_pcap import OusterPcap\n'
        'found = OusterPcap(Path(sys.argv[1]))\n'
        'for number in range(len(found.files)):\n'
        '    points, columns = found.scan(number)\n'
        '    stamp_ns = found.stamps_ns[number]\n'
        '    np.savez(f"{sys.argv[2]}/{number}", points=points, stamp_ns=stamp_ns, **columns)\n'
    )
    result = subprocess.run(
        [python, '-c', read, str(capture), str(tmp_path)],
        capture_output=True,
        text=True,
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
        check=False,
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, '', '')

    here = OusterPcap(capture)
    assert len(list(tmp_path.iterdir())) == NUM_SCANS
    for number in range(NUM_SCANS):
        points, columns = here.scan(number)
        with np.load(tmp_path / f'{number}.npz') as there:
            assert there['stamp_ns'] == here.stamps_ns[number]
            np.testing.assert_allclose(there['points'], points, atol=1e-5)
            for name, values in columns.items():
                np.testing.assert_array_equal(there[name], values)


def test_a_capture_is_replayed_and_described_like_other_scans(capture, tmp_path, capsys):
    assert main(['info', str(capture)]) == 0
    printed = capsys.readouterr().out
    assert 'packets of an Ouster lidar, 3 scans, 0.2 s' in printed
    assert 'intensity, ring, t' in printed
    assert 'replay takes poses from registration, deskewed' in printed

    config = Config.from_mapping({'pose.source': 'identity', 'map.intensity': True})
    result = replay(Request(path=capture, every=2), output=tmp_path / 'out', config=config)
    assert result.summary['scans']['mapped'] == 2
    number = BEAMS * (COLUMNS - LOST) - (COLUMNS - MISSED)
    assert result.mapper.map.num_points == 2 * number


def test_captures_that_cannot_be_read_are_refused_by_name(capture, tmp_path):
    alone = tmp_path / 'alone.pcap'
    alone.write_bytes(capture.read_bytes())
    with pytest.raises(FileFormatError, match=r'alone\.pcap.*metadata'):
        OusterPcap(alone)

    (tmp_path / 'noise.json').write_bytes(capture.with_suffix('.json').read_bytes())
    noise = tmp_path / 'noise.pcap'
    noise.write_bytes(np.random.default_rng(1).bytes(10_000))
    with pytest.raises(FileFormatError, match=r'noise\.pcap'):
        OusterPcap(noise)

    (tmp_path / 'cut.json').write_bytes(capture.with_suffix('.json').read_bytes())
    cut = tmp_path / 'cut.pcap'
    cut.write_bytes(capture.read_bytes()[: capture.stat().st_size // 2])
    with open_recording(Request(path=cut), Config()) as recording:
        assert 1 <= len(recording.files) < NUM_SCANS


@pytest.mark.parametrize('version', [None, '0.14.0'])
def test_without_an_ouster_sdk_that_is_read_the_way_to_install_one_is_named(
    version, tmp_path, monkeypatch
):
    def found(name):
        if version is None:
            raise PackageNotFoundError(name)
        return version

    monkeypatch.setattr('importlib.metadata.version', found)
    with pytest.raises(DependencyError, match=r"pip install 'surfel_mapper\[ouster\]'"):
        OusterPcap(tmp_path / 'drive.pcap')
