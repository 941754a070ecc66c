# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Run the long drive: a row for every block of scans, and a verdict in the end."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import json
import sys

from test.bench.machine import facts
from test.bench.options import Options
from test.bench.report import Row, table
from test.soak import core

BLOCKS = 20

ROAD = 300
"""Scans of the road that is driven up and down."""


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    result = argparse.ArgumentParser(
        prog='python -m test.soak',
        description='Drive up and down the street and watch memory and times.',
    )
    result.add_argument('--scans', type=int, default=1_000_000, metavar='N', help='%(default)s')
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the soaks of the command line."""
    args = parser().parse_args(arguments)
    options = Options(scans=ROAD, beams=32, columns=256)
    print(', '.join(f'{name} {value}' for name, value in facts().items()))
    rows: list[Row] = []
    for row in core.run(args.scans, -(-args.scans // BLOCKS), options):
        rows.append(row)
        print(json.dumps(row), flush=True)
    print(table(rows))
    print(verdict(rows))
    return 0


def verdict(rows: Sequence[Row]) -> str:
    """Return how memory and times have changed from the second block to the last."""
    first, last = rows[min(1, len(rows) - 1)], rows[-1]
    changes = ', '.join(
        f'{name} {last[name] / first[name] - 1.0:+.1%}'
        for name in ('rss_MB', 'median_ms', 'p99_ms')
    )
    return f'from block 2 to {len(rows)}: {changes}; the map equals a new one'


if __name__ == '__main__':
    sys.exit(main())
