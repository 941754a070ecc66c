# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Ratios to other packages that fell since an earlier run of the bench.

Times differ from machine to machine and from hour to hour; ratios of one run (``x_numpy``,
``x_ours``) differ far less, so they are comparable between a release and a later commit, on
another machine of the CI. The earlier run is the text that the bench printed: its lines of JSON
are read, the rest is skipped.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import json
from pathlib import Path

from test.bench.report import Row

NOT_NAMES = ('cpu', 'python', 'numpy', 'numba', 'note', 'less')
"""Columns of text that do not tell the rows of a run apart; all others do."""

SIZES = ('voxel_m', 'window')
"""Columns of numbers that do."""

RATIO = 'x_'
"""Start of the name of a column that holds a ratio; larger is better."""

Ratios = dict[tuple[str, ...], float]
"""Names and sizes of a row, and the column, to its ratio."""

FALLS = 0.85
"""Share of the earlier ratio below which a ratio fell: runs of one commit differ by 10 %."""


def earlier_ratios(path: Path, benches: Sequence[str]) -> Ratios:
    """
    Return the ratios of some benches in the text of an earlier run.

    Raises
    ------
    ValueError
        If it has none, or a line is no JSON.
    OSError
        If the file cannot be read.

    """
    lines = path.read_text(encoding='utf-8').splitlines()
    rows = [json.loads(line) for line in lines if line.startswith('{')]
    found = ratios(row for row in rows if row['bench'] in benches)
    if not found:
        raise ValueError(f'{path}: no ratio of {", ".join(benches)}')
    return found


def fallen(now: Ratios, before: Ratios) -> Iterator[str]:
    """Yield a line for each ratio that fell, and for each that was not measured now."""
    for place, ratio in before.items():
        name = ' '.join(place)
        if place not in now:
            yield f'{name}: {ratio:.3g} before, not measured now'
        elif now[place] < FALLS * ratio:
            yield f'{name}: {ratio:.3g} before, {now[place]:.3g} now'


def ratios(rows: Iterable[Row]) -> Ratios:
    """Return the ratios of rows by the texts and sizes that tell them apart."""
    found: Ratios = {}
    for row in rows:
        texts = [v for k, v in row.items() if isinstance(v, str) and k not in NOT_NAMES]
        sizes = [f'{name} {row[name]}' for name in SIZES if name in row]
        for column, value in row.items():
            if column.startswith(RATIO) and value is not None:
                found[(*texts, *sizes, column)] = float(value)
    return found
