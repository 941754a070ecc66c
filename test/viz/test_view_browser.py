# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper view --browser`` in a real browser: the map is drawn, on loopback only."""

from __future__ import annotations

import io
import os
from pathlib import Path
import re
import signal
import subprocess
import sys

import numpy as np
from PIL import Image
import pytest

from test import extras
from test.viz.test_report_browser import BROWSER, browser, picture_until, WAIT_S
from test.viz.test_show import ground_map
from test.viz.test_viewer import addresses

pytestmark = [
    pytest.mark.skipif(BROWSER is None, reason='no browser on the PATH'),
    extras.needs('playwright', 'rerun'),
]

__all__ = ['browser']  # a fixture


@pytest.fixture(scope='module')
def served(tmp_path_factory):
    """Serve a map until the end of the tests; yield the address of the page."""
    tmp_path = tmp_path_factory.mktemp('served')
    ground_map().save(tmp_path / 'map.npz')
    command = [sys.executable, '-m', 'surfel_mapper.cli.main', 'view', str(tmp_path / 'map.npz')]
    environment = {**os.environ, 'BROWSER': 'true'}
    with subprocess.Popen(
        [*command, '--browser'], stdout=subprocess.PIPE, text=True, env=environment
    ) as view:
        found = (re.match(r'(http://127\.0\.0\.1:\d+/\S*)', line) for line in view.stdout)
        address = next(filter(None, found))[1]
        yield address
        view.send_signal(signal.SIGTERM)
        view.stdout.read()
        assert view.wait(WAIT_S) == 0
    assert not any(map(addresses, ports_of(address)))


def ports_of(address):
    """Return the ports of a page and of its data."""
    return {int(port) for port in re.findall(r'(?::|%3A)(\d+)', address)}


def drawn(page):
    """Return the picture of the map, below the title and above the time line."""
    shot = Image.open(io.BytesIO(page.screenshot())).convert('RGB')
    return np.asarray(shot.crop((0, 70, 450, 320))) / np.float32(255.0)


def test_a_map_is_drawn_in_a_browser(browser, served):
    # so small that the viewer leaves out its panels: a pixel costs the processor 20 us
    page = browser.new_page(viewport={'width': 450, 'height': 510})
    page.set_default_timeout(1000 * WAIT_S)
    page.goto(f'{served}&renderer=webgl')

    def is_drawn(image):  # level ground is bluish; grid and text are grey
        colour = image[np.ptp(image, axis=2) > 0.05]
        return len(colour) > 5_000 and (colour.argmax(axis=1) == 2).mean() > 0.9

    assert is_drawn(picture_until(is_drawn, lambda: drawn(page)))
    before = drawn(page)
    page.mouse.move(250, 200)
    page.mouse.wheel(0, -400)
    nearer = picture_until(lambda image: np.abs(image - before).mean() > 0.01, lambda: drawn(page))
    assert np.abs(nearer - before).mean() > 0.01
    page.close()


@pytest.mark.skipif(not Path('/proc/net/tcp').exists(), reason='sockets are not shown')
def test_the_page_is_served_on_loopback_only(served):
    assert len(ports_of(served)) == 2
    for port in ports_of(served):
        assert addresses(port) == {'127.0.0.1'}
