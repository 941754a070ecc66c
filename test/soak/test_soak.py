# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A short run of the long drive: every scan is mapped, and the map equals a new one."""

import pytest

from test.bench.options import Options
from test.soak import core


@pytest.fixture
def options(tmp_path):
    return Options(scans=5, beams=8, columns=64, cache=tmp_path)


def test_the_road_is_driven_up_and_down():
    places = [(turn, place) for _, turn, place in core.there_and_back(9, 4)]
    assert places == [(0, p) for p in (0, 1, 2, 3, 2, 1)] + [(1, p) for p in (0, 1, 2)]


def test_every_block_gives_a_row(options):
    rows = list(core.run(250, 100, options))
    assert [row['scans'] for row in rows] == [100, 200, 250]
    for row in rows:
        assert 0.0 < row['median_ms'] <= row['p99_ms'] <= row['slowest_ms']
        assert row['rss_MB'] > row['map_MB'] > 0.0
