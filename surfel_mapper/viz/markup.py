# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Texts, figures and tables of the report as HTML, escaped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape

from surfel_mapper.errors import escaped


def as_html(text: object) -> str:
    """Return text for a page: control characters, tags and quotes are escaped."""
    return escape(escaped(str(text)))


def html_figures(figures: Mapping[str, object]) -> str:
    """Return figures with their names; an empty string if there are none."""
    cells = ''.join(
        f'<div><dt>{as_html(name)}</dt><dd>{as_html(value)}</dd></div>'
        for name, value in figures.items()
    )
    return f'<dl class="figures">{cells}</dl>' if cells else ''


def html_table(
    titles: Sequence[str],
    rows: Iterable[Sequence[object]],
    num_texts: int = 1,
    colors: Sequence[Sequence[float]] | None = None,
) -> str:
    """
    Return a table of columns of texts, and behind these of numbers.

    Parameters
    ----------
    titles : sequence of str
        Titles of the columns; none for a table without a head.
    rows : iterable of sequence
        The cells of each row.
    num_texts : int
        Number of the columns of texts.
    colors : sequence of (3,) float, optional
        Red, green and blue, 0 to 1, of a swatch before each row.

    """

    def cells(tag: str, values: Sequence[object]) -> str:
        kinds = ['' if column < num_texts else ' class="number"' for column in range(len(values))]
        pairs = zip(kinds, values, strict=True)
        return ''.join(f'<{tag}{kind}>{as_html(value)}</{tag}>' for kind, value in pairs)

    lines = ['<th></th>' * (colors is not None) + cells('th', titles)] if titles else []
    for number, row in enumerate(rows):
        swatch = ''
        if colors is not None:
            rgb = ' '.join(str(round(255.0 * share)) for share in colors[number][:3])
            swatch = f'<td class="swatch" style="background: rgb({rgb})"></td>'
        lines.append(swatch + cells('td', row))
    return f'<table>{"".join(f"<tr>{line}</tr>" for line in lines)}</table>'
