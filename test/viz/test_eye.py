# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The full detail follows the eye of a window: rerun without a display, drawn by its processor."""

from __future__ import annotations

from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import time

import numpy as np
import pytest

from surfel_mapper.viz.contents import contents
from surfel_mapper.viz.eye import followed, target
from surfel_mapper.viz.scene import Scene
from surfel_mapper.viz.server import free_port, rerun_program
from surfel_mapper.viz.show import show_contents, Shown
from test import extras
from test.viz.test_show import ground_map

WAIT_S = 60.0


@pytest.fixture(autouse=True, scope='module')
def needs_a_viewer_that_tells_its_eye():
    experimental = extras.load('rerun.experimental')
    if not hasattr(getattr(experimental, 'ViewerClient', None), 'get_blueprint'):
        pytest.skip('this rerun cannot say where its eye is')


def connected(port):
    from rerun.experimental import ViewerClient

    return ViewerClient.connect(address(port))


@contextmanager
def window(port):
    """Start a window without a display; skip the test if it cannot draw."""
    command = [rerun_program(), '--headless', '--port', str(port), '--bind', '127.0.0.1']
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    ) as process:
        try:
            until(lambda: is_open(process, port))
            yield connected(port), process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


def address(port):
    return f'rerun+http://127.0.0.1:{port}/proxy'


def is_open(process, port):
    if process.poll() is not None:
        pytest.skip('rerun draws nothing here: no Vulkan, not even that of a processor')
    try:
        connected(port).take_screenshot()  # it answers other calls before it finds no Vulkan
    except (ConnectionError, RuntimeError, TimeoutError):
        return False
    return True


def until(condition):
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


class Watched(Shown):
    """Contents that note the places looked at and the levels after each."""

    def __init__(self, shown, client):
        super().__init__(shown.about, shown._tiled)
        self.client, self.places, self.levels = client, [], []

    def look(self, scene, place):
        sent = super().look(scene, place)
        self.places.append(place)
        self.levels.append(self._tiled[0].level.copy())
        if len(self.places) == 1:
            move(self.client, [19.0, 9.0, 0.0])
        else:
            self.client.quit()
        return sent


def move(client, place):
    """Move the eye of a window, as its mouse does: in its blueprint."""
    blueprint = client.get_blueprint().blueprint
    path = next(each for each in blueprint if each.endswith('/EyeControls3D'))
    blueprint[path]['EyeControls3D']['look_target'] = place
    client.set_blueprint(blueprint, 'recording')


def test_detail_follows_the_eye_until_the_window_closes(tmp_path):
    ground_map().save(tmp_path / 'map.npz')
    port = free_port()
    with window(port) as (client, process):
        scene = Scene.to_window(port)
        shown = show_contents(
            scene, list(contents(Path(tmp_path / 'map.npz'))), target=[-20, -10, 0], most_discs=600
        )
        assert shown.is_coarse
        watched = Watched(shown, Quitting(client, process))
        followed(scene, watched)

    np.testing.assert_array_equal(watched.places, [[-20.0, -10.0, 0.0], [19.0, 9.0, 0.0]])
    first, second = watched.levels
    assert first[0] < second[0]  # the tile of the first place: tiles are sorted by i and j
    assert second[-1] < first[-1]


class Quitting:
    """A window that is ended by its process: a client only ends windows that it started."""

    def __init__(self, client, process):
        self.get_blueprint, self.set_blueprint = client.get_blueprint, client.set_blueprint
        self._process = process

    def quit(self):
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait(WAIT_S)


def test_a_blueprint_without_a_3d_view_has_no_place():
    assert target({'/viewport': {'ViewportBlueprint': {}}}) is None
    assert target({'/view/a/EyeControls3D': {'EyeControls3D': {'kind': 'Orbital'}}}) is None
