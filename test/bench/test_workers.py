# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""All ways compared by the bench of workers make the same map; here without workers."""

import pytest

from surfel_mapper.cluster.workers import Workers
from surfel_mapper.offline.request import Request
from test.bench.offline import recorded
from test.bench.options import Options
from test.bench.street import Street
from test.bench.workers import by, check_equal, holds_from, in_one_process


def test_one_process_and_shards_make_the_same_map(tmp_path):
    options = Options(scans=4, beams=8, columns=64, cache=tmp_path)
    requests = [Request(path=recorded(Street(options), options))] * 2

    ways = [in_one_process(requests), by(Workers(), requests)]

    check_equal({digest for digest, _, _ in ways})
    assert ways[0][1] == ways[1][1] > 0.5
    assert all(core_s > 0.0 for _, _, core_s in ways)


def test_maps_that_differ_are_not_compared():
    with pytest.raises(RuntimeError, match='the maps differ'):
        check_equal({'a', 'b'})


@pytest.mark.parametrize(('two_s', 'length_s'), [(5.0, 150.0), (7.0, None)])
def test_how_long_recordings_have_to_be_follows_from_speed_and_start(two_s, length_s):
    speed = [
        {'who': 'one process', 'recorded_s': 100.0, 'seconds': 10.0},
        {'who': 'two workers', 'recorded_s': 100.0, 'seconds': two_s},
    ]
    start = [
        {'who': 'one process', 'seconds': 1.0},
        {'who': 'two workers', 'seconds': 2.5},
    ]
    found = holds_from(speed, start)['recorded_s']
    assert found == (length_s and pytest.approx(length_s))
