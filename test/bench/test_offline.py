# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of replays runs; times are not tested."""

from test.bench import __main__ as bench
from test.bench import offline
from test.bench.options import Options


def test_every_part_of_a_replay_is_timed(tmp_path, monkeypatch):
    monkeypatch.setattr(offline, 'RUNS', 1)
    options = Options(scans=3, beams=8, columns=64, cache=tmp_path)

    rows = bench.run(['offline'], options)

    assert [row['part'] for row in rows] == ['read', 'decode', 'replay', 'command']
    for row in rows:
        assert row['seconds'] > 0.0
        assert row['times_real'] > 0.0
