# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""docs/faults.md and SECURITY.md state the limits and the inputs that the code has."""

from __future__ import annotations

from pathlib import Path
import re

import pytest

from test.fuzz import claims
from test.fuzz.harnesses import HARNESSES
from test.fuzz.test_failures import FEWER, SHARES
from test.soak.long_run import row_of

FIGURE = re.compile(r'\d[\d,]*')


def test_security_states_the_limits_of_the_readers():
    assert not claims.false_limits()


def test_security_has_the_table_of_the_findings():
    assert claims.SECURITY.read_text(encoding='utf-8') == claims.security_page()


def test_a_changed_limit_is_noticed(monkeypatch):
    monkeypatch.setattr(claims.chunked, 'MAX_CHUNKS', 4001)
    assert claims.false_limits() == ['4,001 chunks or one per 512']


def test_the_costs_are_of_all_harnesses_and_no_other():
    assert [*claims.costs()] == [*HARNESSES]


def test_the_total_is_that_of_the_table():
    tried, measured = map(sum, zip(*claims.costs().values(), strict=True))
    text = claims.fault_table.PAGE.read_text(encoding='utf-8')
    row = next(line for line in text.splitlines() if line.startswith(claims.TOTAL))
    assert FIGURE.findall(row[len(claims.TOTAL) :]) == [f'{tried:,}', f'{measured:,}']


def test_a_harness_that_broke_leaves_the_page_as_it_is():
    rows = '\n'.join(f'| {name} | 1 | 2 | 0 | 0.0 | 1 |' for name in [*HARNESSES][1:])
    with pytest.raises(SystemExit, match=f'no row of {next(iter(HARNESSES))}: broken'):
        claims.page_with_costs('', rows)


def log_of(share):
    lost = "{'failed': %d, 'crashed': [%s], 'hung': [], 'last': 9} Exception ignored in: {}"
    return '\n'.join(
        [
            f'share {share} of {SHARES} of the failures',
            f'insert: {share} allocations failed, 0 in a call of numba',
            f'load: 100 allocations failed, {int(share == 3)} in a call of numba',
            'replay: 7 allocations failed',
            f'replay up to its map: {lost % (10 + share, "5" if share == 9 else "")}',
            'killed at 30 steps of writing\n',
        ]
    )


def test_failures_are_added_up_over_the_shares_and_none_is_counted_twice():
    """Shares of the map come again after FEWER, which made four of each of its failures."""
    logs = 'share 2 of 32 of the failures\ninsert: 999 allocations failed, 0 in a call of numba\n'
    logs += ''.join(map(log_of, range(SHARES)))
    found = claims.Failures.of(logs)
    assert found == claims.Failures(
        of_the_map=FEWER * 100 + sum(range(SHARES - FEWER, SHARES)),
        crashed=1,
        of_a_replay=SHARES * 10 + sum(range(SHARES)),
        ended=1,
        sampled=FEWER * 7,
    )
    again = log_of(3).replace('1 in a call', '0 in a call').replace('insert: 3 ', 'insert: 30 ')
    later = claims.Failures.of(logs + again)  # the last of a share counts
    assert (later.crashed, later.of_the_map) == (0, found.of_the_map - 27 + 30)
    with pytest.raises(SystemExit, match='no log of share 0, 31'):
        claims.Failures.of(''.join(map(log_of, range(1, SHARES - 1))))


def test_rows_of_failures_replace_those_of_the_page():
    page = '\n'.join(
        f'{row} 1 | old |'
        for row in (claims.KILLS, claims.OF_THE_MAP, claims.OF_A_REPLAY, claims.SAMPLED)
    )
    logs = ''.join(map(log_of, range(SHARES)))
    assert claims.page_with_failures(page, '') == page
    assert claims.page_with_failures(page, logs).splitlines() == [
        f'{claims.KILLS} 30 and 54 | incomplete files: 0 |',
        f'{claims.OF_THE_MAP} 1,020 | the map is that before or after; 1 ended the process |',
        f'{claims.OF_A_REPLAY} 816 | the whole map or none; 1 ended or stalled the process |',
        f'{claims.SAMPLED} 56 | the same |',
    ]
    with pytest.raises(SystemExit, match='no row of'):
        claims.page_with_failures('', logs)


def test_the_page_has_the_rows_of_failures():
    text = claims.fault_table.PAGE.read_text(encoding='utf-8')
    for row in (claims.KILLS, claims.OF_THE_MAP, claims.OF_A_REPLAY, claims.SAMPLED):
        assert f'\n{row} ' in text
    assert f' and {claims.kills_of_tests()} | incomplete files: 0 |' in text


def test_tests_that_the_pages_name_exist():
    root = Path(__file__).parents[2]
    for page in (claims.SECURITY, claims.fault_table.PAGE):
        for name in re.findall(r'`(test/[\w/]+\.py)`', page.read_text(encoding='utf-8')):
            assert (root / name).is_file(), name


def test_the_row_of_a_long_run_replaces_that_of_its_command():
    blocks = [{'scans': 10 * n, 'rss_MB': 100.0 + n, 'median_ms': 1.0 * n} for n in (1, 2, 3)]
    row = row_of('-m test.soak.faults 10', [*blocks, {'clouds_lost': 4}], 'equal')
    assert row == (
        '| `python -m test.soak.faults 10` | 30 | all | 4 | 102 to 103 MB (+1.0%) | 1.0 to 3.0 |  '
        '| equal |'
    )
    page = '| `python -m test.soak.faults 10` | old |\n| `python -m test.soak` | other |\n'
    log = f'{{"scans": 1}}\n{row}\n'
    assert claims.page_with_runs(page, log) == f'{row}\n| `python -m test.soak` | other |\n'
    with pytest.raises(SystemExit, match='no row of'):
        claims.page_with_runs('', log)
