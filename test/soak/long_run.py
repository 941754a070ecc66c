# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The row of docs/faults.md about a long run, which each of them prints at its end.

``python -m test.fuzz.claims LOG`` puts it into the page in place of the earlier row of the
same command. Stands alone because three programs print it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

HEAD = (
    '| run | scans | mapped | lost | memory of the process, block 2 to last | ms per scan, median '
    'of blocks | p99, ms | result |\n|---|---|---|---|---|---|---|---|'
)


def row_of(command: str, rows: Sequence[Mapping[str, Any]], result: str) -> str:
    """
    Return the row of a run.

    Parameters
    ----------
    command : str
        Arguments of Python: ``-m test.soak``.
    rows : sequence of mapping
        Of each block: scans, mapped, rss_MB, median_ms, p99_ms; sent and clouds_lost in the last.
    result : str
        Checks at the end.

    """
    blocks = [row for row in rows if 'rss_MB' in row]
    first, last = blocks[min(1, len(blocks) - 1)], blocks[-1]
    before, after = first['rss_MB'], last['rss_MB']
    cells = [
        f'`python {command}`',
        f'{rows[-1].get("sent", last["scans"]):,}',
        f'{last["mapped"]:,}' if 'mapped' in last else 'all',
        str(rows[-1].get('clouds_lost', 0)),
        f'{before:.0f} to {after:.0f} MB ({after / before - 1.0:+.1%})',
        span(blocks, 'median_ms'),
        span(blocks, 'p99_ms'),
        result,
    ]
    return f'| {" | ".join(cells)} |'


def span(blocks: Sequence[Mapping[str, Any]], name: str) -> str:
    """Return the least and the largest value of the blocks, or nothing if they have none."""
    values = [block[name] for block in blocks if name in block]
    return f'{min(values):.1f} to {max(values):.1f}' if values else ''
