# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Rows of figures: statistics of times, and rows as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Row = Mapping[str, Any]
"""Columns to values, in the order to print; a value may be missing or None."""


def spread(milliseconds: Sequence[float]) -> dict[str, float]:
    """
    Return median, 10th and 99th percentile, and slowest of the times of scans.

    The 10th percentile is near the median of a quiet machine.
    """
    return {
        'median_ms': float(np.median(milliseconds)),
        'p10_ms': float(np.percentile(milliseconds, 10)),
        'p99_ms': float(np.percentile(milliseconds, 99)),
        'slowest_ms': float(np.max(milliseconds)),
    }


def table(rows: Sequence[Row]) -> str:
    """Return rows as text: columns in order of first appearance, numbers to the right."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [[text(row.get(name)) for name in names] for row in rows]
    numeric = [any(isinstance(row.get(name), (int, float)) for row in rows) for name in names]
    widths = [max(len(line[place]) for line in [names, *cells]) for place in range(len(names))]
    return '\n'.join(
        '  '.join(
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(line, widths, numeric, strict=True)
        ).rstrip()
        for line in [names, *cells]
    )


def text(value: Any) -> str:
    """Return a value as text for a table: three digits if small, none if large."""
    if value is None:
        return ''
    if isinstance(value, float):
        return f'{value:.0f}' if abs(value) >= 100.0 else f'{value:.3g}'
    return str(value)
