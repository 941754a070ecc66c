# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The layer of docs/extending.md, added from outside: through a pipeline; live in test/ros."""

from __future__ import annotations

from pathlib import Path
import re
import sys

import numpy as np
import pytest

from surfel_mapper import layers
from surfel_mapper.config import Config, unregister_stage
from surfel_mapper.errors import ConfigError
from surfel_mapper.offline.replay import replay, ReplayOptions
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from test.bags import recorded

pytestmark = pytest.mark.usefixtures('undrawn')

PAGE = Path(__file__).parents[2] / 'docs' / 'extending.md'
SWITCH = {'layers.heights.enabled': True, 'pose.source': 'identity'}
POINTS = np.array([[0.1, 0.1, 3.0], [0.2, 0.2, -1.0], [0.7, 0.1, 2.0], [np.nan, 0.0, -9.0]])


def install(folder):
    """Write the module of the page into a folder, with the metadata of a package."""
    (code,) = re.findall(r'```python\n(# heights\.py\n.*?)```', PAGE.read_text('utf-8'), re.DOTALL)
    (folder / 'heights.py').write_text(code, encoding='utf-8')
    info = folder / 'heights-1.0.dist-info'
    info.mkdir()
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: heights\nVersion: 1.0\n')
    (info / 'entry_points.txt').write_text('[surfel_mapper.layers]\nheights = heights\n')


@pytest.fixture
def heights(tmp_path, monkeypatch):
    """Give the module, registered until the end of a test."""
    install(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    import heights

    yield heights
    layers.unregister('heights')
    unregister_stage(heights.HeightsConfig)
    del sys.modules['heights']


def mapped(config):
    mapper = Mapper(config)
    mapper.add_scan(Scan(points=POINTS, stamp_ns=10**9, frame_id='odom'))
    return mapper, list(mapper.insert_ready())


def test_a_layer_from_outside_follows_scans(heights):
    mapper, (update,) = mapped(Config.from_mapping(SWITCH))
    assert update.layers['heights'] == update.heights == 2
    assert mapper.heights.lowest == {(0, 0): -1.0, (1, 0): 2.0}
    assert mapper.summary()['heights'] == {'columns': 2}
    assert update.milliseconds['heights'] > 0.0
    mapper.clear()
    assert mapper.heights.lowest == {}


def test_a_layer_from_outside_is_off_by_default(heights):
    mapper, (update,) = mapped(Config.from_mapping({'pose.source': 'identity'}))
    assert mapper.heights is None
    assert update.heights is None


def test_settings_of_a_layer_from_outside_are_checked_and_change_while_running(heights, tmp_path):
    config = Config.from_mapping(SWITCH)
    with pytest.raises(ConfigError, match=r'layers\.heights\.margin_m: 11'):
        config.replace({'layers.heights.margin_m': 11.0})
    mapper, _ = mapped(config)
    mapper.reconfigure(config.replace({'layers.heights.margin_m': 0.5}))
    (path,) = mapper.heights.write(tmp_path, ())
    assert path.read_text() == '0 0 -0.500\n1 0 2.500\n'
    with pytest.raises(ConfigError, match=r'layers\.heights\.enabled: cannot change'):
        mapper.reconfigure(config.replace({'layers.heights.enabled': False}))


def test_a_layer_from_outside_writes_a_format_of_its_own(heights, tmp_path):
    layers.unregister('heights')
    file = {'columns': 'heights.txt'}
    layers.register('heights', 'heights:HeightsLayer', 'layers.heights.enabled', file)
    bag = recorded.write_rosbag2(tmp_path / 'bag', recorded.drive())
    options = ReplayOptions(formats=('ply', 'columns'))
    with pytest.raises(ConfigError, match=r'columns is written by the layer heights, expected '):
        replay(bag, output=tmp_path / 'off', options=options)
    config = Config.from_mapping({'layers.heights.enabled': True})
    done = replay(bag, output=tmp_path / 'on', config=config, options=options)
    assert tmp_path / 'on' / 'heights.txt' in done.written
    assert (tmp_path / 'on' / 'heights.txt').read_text().count('\n') == len(
        done.mapper.heights.lowest
    )


def test_two_layers_of_one_name_are_refused(heights):
    with pytest.raises(ConfigError, match=r'heights:HeightsLayer has this name'):
        layers.register('heights', 'elsewhere:HeightsLayer')
