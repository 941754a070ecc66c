# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Full disks, read-only directories, descriptors, killed processes: files stay complete."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')


from surfel_mapper.config import Config
from surfel_mapper.files.atomic import remove_abandoned
from surfel_mapper.files.map_state import load_map
from surfel_mapper.files.ply import read_points
from surfel_mapper.pipeline import Mapper
from surfel_mapper.ros.map_files import save_map
from surfel_mapper.scan import Scan
from test.ros.driving import ARGUMENTS, drive, send
from test.ros.fault_table import fault
from test.ros.live import node_and_peer, ROOT


def mapper_of(num_scans, folder):
    """Return a mapper with some scans that saves to a folder."""
    mapper = Mapper(
        Config.from_mapping({'pose.source': 'identity', 'output.directory': str(folder)})
    )
    for number in range(num_scans):
        points = np.random.default_rng(number).uniform(-4.0, 4.0, (2000, 3))
        mapper.add_scan(Scan(points=points, stamp_ns=(number + 1) * 10**8, frame_id='odom'))
        list(mapper.insert_ready())
    return mapper


def ends_at(number, how, function):
    """Call a function in a process killed at a step of writing; return whether it was killed."""
    child = os.fork()
    if child:
        return os.WIFSIGNALED(os.waitpid(child, 0)[1])
    if how != signal.SIGKILL:
        signal.signal(how, signal.SIG_DFL)
    steps = itertools.count()

    def come_to_a_step():
        if next(steps) == number:
            os.kill(os.getpid(), how)

    def stepping(original):
        def step(*args):
            come_to_a_step()
            original(*args)
            come_to_a_step()

        return step

    os.fsync, os.replace = stepping(os.fsync), stepping(os.replace)
    try:
        function()
    finally:
        os._exit(0)


STEPS_OF_SAVING = 12
"""Two files: the flush of each, its rename and the flush of its directory, before and after."""


SIGNALS = (signal.SIGKILL, signal.SIGTERM)


def leftovers(folder):
    return [path for path in folder.iterdir() if path.suffix == '.part']


@fault(
    'SIGKILL or SIGTERM at any step of `~/save_map`',
    happens='each file is complete, either the old or the new one',
    counted='nothing',
    lost='at most the map being saved; a `.part` file remains until the next start',
)
@pytest.mark.parametrize('how', SIGNALS)
def test_killing_the_process_while_saving_leaves_complete_maps(tmp_path, how):
    old, new = mapper_of(2, tmp_path), mapper_of(3, tmp_path)
    digests = {old.map.digest(), new.map.digest()}
    sizes = {len(m.map.surfels(5)) for m in (old, new)}
    number = 0
    while True:
        save_map(old)
        was_ended = ends_at(number, how, lambda: save_map(new))
        assert load_map(tmp_path / 'map.npz')[0].digest() in digests
        assert len(read_points(tmp_path / 'map.ply')['x']) in sizes
        if not was_ended:
            break
        number += 1
    assert number == STEPS_OF_SAVING
    assert load_map(tmp_path / 'map.npz')[0].digest() == new.map.digest()
    assert len(leftovers(tmp_path)) == len(remove_abandoned(tmp_path)) <= 8
    assert not leftovers(tmp_path)


class Disk:
    """A small file system mounted for a test."""

    def __init__(self, folder):
        self.folder = folder
        folder.mkdir()
        self.mount('size=256k')

    def mount(self, options):
        done = subprocess.run(
            ['mount', '-t', 'tmpfs', '-o', options, 'tmpfs', str(self.folder)],
            capture_output=True,
            check=False,
        )
        if done.returncode:
            pytest.skip('mounting is not allowed here')

    def unmount(self):
        subprocess.run(['umount', '--lazy', str(self.folder)], check=False)


@pytest.fixture
def disk(tmp_path):
    if shutil.which('mount') is None:
        pytest.skip('no mount')
    disk = Disk(tmp_path / 'disk')
    yield disk
    disk.unmount()


@pytest.fixture(scope='module')
def running(prefork, tmp_path_factory):
    maps = tmp_path_factory.mktemp('files') / 'maps'
    with node_and_peer(prefork, maps, *ARGUMENTS) as (node, peer):
        peer.advertise('/odom', '/points')
        send(peer, drive(3))
        peer.diagnosis({'scans.mapped': 3})
        yield node, peer, maps


def save(peer):
    """Call ~/save_map; return (success, message)."""
    answer = peer.call('save_map')
    return answer.success, answer.message


def check_unaffected(node, peer):
    """Check that a node runs and has lost no scan."""
    node.check()
    _, values = peer.diagnosis()
    assert values['scans.mapped'] == values['scans.received'] == '3'


def link(maps, target):
    """Replace the directory of maps by a link."""
    if maps.is_symlink():
        maps.unlink()
    elif maps.exists():
        maps.rename(maps.with_name(f'{maps.name}_{target.name}'))
    maps.symlink_to(target)


@fault(
    'disk full while saving',
    happens='refused with the reason; earlier files stay; works again once there is space',
    counted='the answer of the service, and the log',
    lost='nothing: the map is in memory',
)
def test_a_full_disk_is_reported_and_the_node_continues(running, disk):
    node, peer, maps = running
    link(maps, disk.folder)
    filler = disk.folder / 'filler'
    filler.write_bytes(bytes(250 << 10))
    success, said = save(peer)
    assert not success
    assert 'No space left on device' in said
    assert not leftovers(disk.folder)
    filler.unlink()
    disk.unmount()
    disk.mount('size=64m')
    assert save(peer)[0]
    check_unaffected(node, peer)


@fault(
    'read-only directory',
    happens='refused with the reason; the node continues',
    counted='the answer of the service, and the log',
    lost='nothing: the map is in memory',
)
def test_a_read_only_directory_is_reported_and_the_node_continues(running, disk):
    node, peer, maps = running
    disk.unmount()
    disk.mount('ro')
    link(maps, disk.folder)
    success, said = save(peer)
    assert not success
    assert 'Read-only file system' in said
    check_unaffected(node, peer)


@fault(
    'cache directory of compiled kernels unwritable',
    happens='a temporary one is used, so kernels are compiled at every start; a warning',
    counted='the log',
    lost='half a minute at the start',
)
def test_kernels_load_without_a_cache_directory(disk, tmp_path):
    disk.unmount()
    disk.mount('size=32m')
    package = disk.folder / 'surfel_mapper'
    shutil.copytree(
        ROOT / 'surfel_mapper', package, ignore=shutil.ignore_patterns('__pycache__', 'viz')
    )
    subprocess.run(['mount', '-o', 'remount,ro', str(disk.folder)], check=True)
    unwritable = {'HOME': '/proc/nowhere', 'NUMBA_CACHE_DIR': '/proc/nowhere'}
    code = 'from surfel_mapper.kernels import grouping; print(grouping.__file__)'
    done = subprocess.run(
        [sys.executable, '-c', code],
        cwd=tmp_path,
        env={**os.environ, **unwritable, 'PYTHONPATH': str(disk.folder), 'TMPDIR': str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(package / 'kernels' / 'grouping.py')
    assert 'set NUMBA_CACHE_DIR' in done.stderr
    assert not list(tmp_path.glob('surfel_mapper-kernels-*'))
