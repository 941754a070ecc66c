# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Other readers read the files of a replay; bad input and full disks leave no partial files."""

import json

from mcap.writer import CompressionType
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from surfel_mapper.cli.main import main
from surfel_mapper.files.map_state import load_map
from surfel_mapper.files.parquet import read_map
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.mapping.surfels import Surfels
from test import extras
from test.bags.recorded import (
    cut,
    drive,
    HEIGHT_M,
    MOUNT_M,
    NUM_SCANS,
    PERIOD_NS,
    START_NS,
    write_mcap,
    write_rosbag2,
)
from test.cli.small_disk import run_on_small_disk

pytestmark = pytest.mark.usefixtures('undrawn')

ALL = 'ply,pcd,parquet,npz,bag' if extras.has('pyarrow') else 'ply,pcd,npz,bag'


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_rosbag2(tmp_path_factory.mktemp('bags') / 'drive', drive())


@pytest.fixture(scope='module')
def output(bag, tmp_path_factory):
    """Return the output directory of a replay in every format."""
    output = tmp_path_factory.mktemp('out') / 'map'
    poses = ['--poses-out', str(output.with_name('poses.tum'))]
    assert main(['replay', str(bag), '--formats', ALL, '--output', str(output), *poses]) == 0
    return output


def contents(directory):
    """Return every file below a directory with its bytes."""
    files = (path for path in directory.rglob('*') if path.is_file())
    return {path.relative_to(directory).as_posix(): path.read_bytes() for path in files}


def test_maps_that_are_exact_have_the_digest_of_the_summary(output):
    digest = json.loads((output / 'summary.json').read_text())['digest']

    assert load_map(output / 'map.npz')[0].digest() == digest
    extras.load('pyarrow')
    assert read_map(output / 'map.parquet').digest() == digest


def test_ply_pcd_and_bag_hold_the_same_surfels_to_their_own_readers(output):
    plyfile, pypcd4 = pytest.importorskip('plyfile'), pytest.importorskip('pypcd4')
    vertices = plyfile.PlyData.read(output / 'map.ply')['vertex']
    cloud = pypcd4.PointCloud.from_path(output / 'map.pcd').pc_data
    with AnyReader([output / 'normals']) as reader:
        (connection,) = (c for c in reader.connections if c.topic == '/surfel_mapper/normals')
        *_, (_, _, raw) = reader.messages([connection])
        message = reader.deserialize(raw, connection.msgtype)
    names = [field.name for field in message.fields]
    assert message.point_step == 4 * len(names)
    rows = dict(zip(names, message.data.view('<f4').reshape(-1, len(names)).T, strict=True))

    for name in ('x', 'y', 'z', 'planarity', 'curvature'):
        expected = np.asarray(vertices[name], np.float32)
        np.testing.assert_array_equal(cloud[name], expected)
        np.testing.assert_array_equal(rows[name], expected)
    for axis in 'xyz':
        np.testing.assert_array_equal(cloud[f'normal_{axis}'], vertices[f'n{axis}'])
        np.testing.assert_array_equal(rows[f'normal_{axis}'], vertices[f'n{axis}'])
    np.testing.assert_array_equal(cloud['num_points'], vertices['num_points'])


def test_adaptive_surfels_are_in_files_and_bag(bag, tmp_path):
    output, formats = tmp_path / 'map', ['--formats', 'ply,npz,bag']
    assert main(['replay', str(bag), '--adaptive', *formats, '--output', str(output)]) == 0
    surfel_map = load_map(output / 'map.npz')[0]
    expected = surfel_map.adaptive(5)
    assert len(expected) < surfel_map.num_surfels(5)
    with AnyReader([output / 'normals']) as reader:
        (connection,) = (c for c in reader.connections if c.topic == '/surfel_mapper/normals')
        *_, (_, _, raw) = reader.messages([connection])
        last = Surfels.from_message(reader.deserialize(raw, connection.msgtype))
    plyfile = pytest.importorskip('plyfile')
    vertices = plyfile.PlyData.read(output / 'map.ply')['vertex']
    for surfels in (last.num_points, vertices['num_points']):
        np.testing.assert_array_equal(np.sort(surfels), np.sort(expected.num_points))
    np.testing.assert_array_equal(np.sort(vertices['size']), np.sort(expected.size))


def test_the_bag_plays_in_step_with_the_input(output):
    with AnyReader([output / 'normals']) as reader:
        found = [(c.topic, time) for c, time, _ in reader.messages()]
        frames = {
            reader.deserialize(raw, c.msgtype).header.frame_id for c, _, raw in reader.messages()
        }

    changed = [time for topic, time in found if topic == '/surfel_mapper/changed']
    assert changed == [START_NS + i * PERIOD_NS for i in range(NUM_SCANS)]
    maps = [time for topic, time in found if topic == '/surfel_mapper/normals']
    assert maps == [changed[0], changed[-1]]
    assert frames == {'odom'}


def test_the_poses_are_where_the_sensor_was(output):
    found = read_trajectory(output.with_name('poses.tum'))

    assert found.stamp_ns.tolist() == [START_NS + i * PERIOD_NS for i in range(NUM_SCANS)]
    expected = [np.array([0.5 * i, 0.0, HEIGHT_M]) + MOUNT_M for i in range(NUM_SCANS)]
    np.testing.assert_array_equal(found.xyz, expected)


@pytest.mark.parametrize(
    ('arguments', 'code', 'says'),
    [
        (['--formats', 'stl'], 2, "'stl', expected some of ply, pcd"),
        (['--mount', '/points=1,2,3'], 2, 'expected TOPIC=X,Y,Z,QX,QY,QZ,QW'),
        (['--mount', '/points=1,2,3,0,0,0,2'], 2, 'quaternion of norm 1'),
        (['--poses-format', 'xyz'], 2, 'invalid choice'),
        (['--start', '-1'], 2, "'-1', expected seconds, zero or more"),
        (['--start', '99'], 1, 'start 99 s, expected 0 to'),
        (['--duration', 'nan'], 2, "'nan', expected a positive number"),
        (['--every', '0'], 2, 'expected a whole number of 1 or more'),
        (['--poses-from', 'file'], 2, 'expected both'),
        (['--poses-from', 'tf', '--poses', 'a'], 2, 'expected both'),
        (['--poses', '/no/file'], 1, '/no/file: cannot be read: No such file'),
    ],
)
def test_contradictory_arguments_are_refused(bag, tmp_path, capsys, arguments, code, says):
    try:
        found = main(['replay', str(bag), *arguments, '--output', str(tmp_path / 'out')])
    except SystemExit as error:
        found = error.code

    assert found == code
    assert says in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def spoiled(tmp_path, kind):
    """Return a path of bad input."""
    path = tmp_path / kind
    if kind == 'empty.mcap':
        path.touch()
    elif kind == 'zeros.db3':
        path.write_bytes(bytes(5000))
    elif kind == 'text.bag':
        path.write_text('no bag at all\n' * 100)
    elif kind == 'folder':
        path.mkdir()
        (path / 'notes.txt').touch()
    elif kind == 'outside':
        (tmp_path / 'secret.mcap').write_bytes(b'\x89MCAP0\r\n')
        path.mkdir()
        (path / 'metadata.yaml').write_text(
            'rosbag2_bagfile_information:\n  relative_file_paths: [../secret.mcap, /etc/passwd]\n'
        )
    elif kind == 'table.parquet':
        path.write_bytes(b'PAR1' + bytes(100))
    elif kind == 'damaged':
        write_rosbag2(path, drive())
        content = bytearray((path / 'damaged.mcap').read_bytes())
        content[100::7] = bytes(len(range(100, len(content), 7)))
        (path / 'damaged.mcap').write_bytes(content)
    return path


BAD = (
    *('empty.mcap', 'zeros.db3', 'text.bag', 'folder', 'outside', 'table.parquet', 'damaged'),
    'none',
)


@pytest.mark.parametrize('kind', BAD)
@pytest.mark.parametrize('verb', ['replay', 'info'])
def test_bad_input_is_refused_in_a_line_and_leaves_nothing(
    tmp_path, monkeypatch, capsys, verb, kind
):
    path = spoiled(tmp_path, kind)
    (tmp_path / 'here').mkdir()
    monkeypatch.chdir(tmp_path / 'here')
    options = ['--formats', ALL] if verb == 'replay' else []

    assert main([verb, str(path), *options]) == 1

    printed = capsys.readouterr()
    assert printed.out == ''
    assert printed.err.startswith(f'surfel-mapper {verb}: {path}')
    assert len(printed.err.splitlines()) == 1
    assert list((tmp_path / 'here').iterdir()) == []


def test_a_cut_bag_is_mapped_as_far_as_it_goes_and_strict_says_so(tmp_path, capsys, caplog):
    path = write_mcap(tmp_path / 'drive.mcap', drive(), compression=CompressionType.NONE)
    cut(path, 0.7)
    arguments = ['replay', str(path), '--json', '--output', str(tmp_path / 'out'), '--overwrite']

    assert main(arguments) == 0
    plain = json.loads(capsys.readouterr().out)
    assert main([*arguments, '--strict']) == 3
    strict = json.loads(capsys.readouterr().out)

    assert plain['digest'] == strict['digest']
    assert plain['scans']['mapped'] == 4  # 4.2 of 6
    assert f'{path}: the file is cut off or damaged at byte ' in plain['cut'][0]
    assert plain['cut'][0] in caplog.text


ON_A_SMALL_DISK = """
import json, sys
from pathlib import Path
from surfel_mapper.cli.main import main
from test.cli.small_disk import filled
from test.cli.test_replay_files import contents

disk, bag = Path(sys.argv[1]), sys.argv[2]
arguments = ['replay', bag, '--output', str(disk / 'earlier'), '--json', '--overwrite']
assert main([*arguments, '--formats', sys.argv[3], '--duration', '0.3']) == 0
before = contents(disk)
for name in sys.argv[3].split(','):
    with filled(disk):
        code = main([*arguments, '--formats', name])
    print(json.dumps([name, code, contents(disk) == before]))
"""


def test_a_full_disk_leaves_the_earlier_result_whole(bag, tmp_path):
    done = run_on_small_disk(ON_A_SMALL_DISK, tmp_path, bag, ALL, size='8m')
    found = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('[')]
    assert found == [[name, 1, True] for name in ALL.split(',')], done.stderr
    assert done.stderr.count('cannot be written: No space left on device') == len(found)
