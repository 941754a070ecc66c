# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Saving in a thread of its own: the file, requests that are one, and stale temporary files."""

from __future__ import annotations

import threading

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from surfel_mapper.files.map_state import load_map
from surfel_mapper.ros import map_files
from surfel_mapper.ros.map_files import MapWriter
from surfel_mapper.ros.mapping_thread import MappingThread
from test.pipeline.made_scans import insert, mapper_with, scan_at
from test.ros.driving import ARGUMENTS
from test.ros.live import TIMEOUT_S


@pytest.fixture
def mapper(tmp_path):
    mapper = mapper_with(pose__source='identity', output__directory=str(tmp_path))
    insert(mapper, scan_at(1.0))
    return mapper


@pytest.fixture
def thread(mapper):
    thread = MappingThread(mapper, pytest.fail)
    thread.start(lambda update: None)
    yield thread
    thread.stop()


def test_scans_are_mapped_while_the_map_of_before_is_written(
    mapper, thread, tmp_path, monkeypatch
):
    entered, finish = threading.Event(), threading.Event()
    write_surfels = map_files.write_surfels

    def slow(*arguments):
        entered.set()
        assert finish.wait(TIMEOUT_S)
        write_surfels(*arguments)

    monkeypatch.setattr(map_files, 'write_surfels', slow)
    expected = mapper.map.digest()
    writer = MapWriter(mapper, thread)
    saved = writer.save()
    assert entered.wait(TIMEOUT_S)
    thread.call(lambda: insert(mapper, scan_at(2.0))).result(TIMEOUT_S)
    assert mapper.map.digest() != expected
    finish.set()

    assert saved.result(TIMEOUT_S).endswith(f'of 1 scan (1 received), digest {expected}')
    assert load_map(tmp_path / 'map.npz')[0].digest() == expected
    writer.close()


def test_saves_that_wait_are_one(mapper, thread):
    busy, finish = threading.Event(), threading.Event()
    thread.call(lambda: (busy.set(), finish.wait(TIMEOUT_S)))
    assert busy.wait(TIMEOUT_S)
    writer = MapWriter(mapper, thread)
    first = writer.save()
    while not first.running():
        threading.Event().wait(0.01)
    others = [writer.save() for _ in range(100)]
    assert len(set(others)) == 1
    assert others[0] is not first
    thread.call(lambda: insert(mapper, scan_at(2.0)))
    finish.set()

    assert others[0].result(TIMEOUT_S).endswith(f'digest {mapper.map.digest()}')
    assert writer.save() is not others[0]
    writer.close()


def test_files_of_a_killed_node_are_removed_at_the_next_start(start, peer, tmp_path):
    folder = tmp_path / 'kept'
    folder.mkdir()
    part = folder / '.surfel_mapper-0011223344556677.part'
    part.write_bytes(b'half a map')
    node = start('node', *ARGUMENTS, '-p', f'output.directory:={folder}')
    peer.diagnosis({'state': 'active'})
    assert not part.exists()
    assert f'{part} removed: its process died' in node.output
