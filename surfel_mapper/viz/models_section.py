# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What report.html says of models: how many there are, a picture, and the largest in a table."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from surfel_mapper.messages.model_markers import primitive_colors
from surfel_mapper.models.multi_model import MultiModel
from surfel_mapper.models.shapes import PatchShape

MOST_ROWS = 25
"""So many planes and surfaces have a row, the largest."""

TITLES = ('area (m\u00b2)', 'points', 'rms (mm)', 'slope (deg)')


def models_section(
    model: MultiModel, shapes: Sequence[PatchShape], picture: str | Path | None = None
) -> str:
    """
    Return the section of a report about models, as HTML.

    Parameters
    ----------
    model : MultiModel
        The models.
    shapes : sequence of PatchShape
        Of its planes and surfaces.
    picture : str or Path, optional
        A PNG file of them.

    """
    largest = sorted(shapes, key=lambda shape: -shape.area_m2)[:MOST_ROWS]
    drawn = ''
    if picture is not None:
        png = base64.b64encode(Path(picture).read_bytes()).decode()
        drawn = f'<img class="models" alt="the models, drawn" src="data:image/png;base64,{png}">'
    note = ''
    if len(shapes) > MOST_ROWS:
        note = f'<p class="none">The largest {MOST_ROWS} of {len(shapes):,}.</p>'
    parts = (figures(model, shapes), drawn, table(largest), note)
    return f'<h2>Planes, surfaces, Gaussians</h2>{"".join(parts)}'


def figures(model: MultiModel, shapes: Sequence[PatchShape]) -> str:
    """Return how many models there are, and how large they are."""
    labels = model.labels
    in_patches = np.isin(labels, [shape.patch.id for shape in shapes])
    shown = {
        'planes': f'{len(model.planes):,}',
        'surfaces': f'{len(model.surfaces):,}',
        'Gaussians': f'{len(model.gaussians):,}',
        'area of planes': f'{sum(s.area_m2 for s in shapes if not s.is_curved):.1f} m\u00b2',
        'area of surfaces': f'{sum(s.area_m2 for s in shapes if s.is_curved):.1f} m\u00b2',
        'surfels on them': f'{100.0 * in_patches.sum() / max(len(labels), 1):.1f} %',
        'bytes when packed': f'{model.size_bytes:,}',
    }
    cells = ''.join(f'<div><dt>{k}</dt><dd>{v}</dd></div>' for k, v in shown.items())
    return f'<dl class="figures">{cells}</dl>'


def table(shapes: Sequence[PatchShape]) -> str:
    """Return a table of planes and surfaces, with their colours; nothing of none."""
    if not shapes:
        return ''
    rows = ''.join(map(row, shapes))
    numbers = ''.join(f'<th class="number">{title}</th>' for title in TITLES)
    return f'<table><tr><th></th><th>id</th><th>kind</th>{numbers}</tr>{rows}</table>'


def row(shape: PatchShape) -> str:
    """Return the row of a plane or surface."""
    patch = shape.patch
    red, green, blue = np.rint(255.0 * primitive_colors([patch.id])[0]).astype(int)
    slope_deg = np.degrees(np.arccos(min(abs(patch.normal[2]), 1.0)))
    values = (
        f'{shape.area_m2:.2f}',
        f'{patch.num_points:,}',
        f'{1e3 * patch.rms_m:.1f}',
        f'{slope_deg:.1f}',
    )
    numbers = ''.join(f'<td class="number">{value}</td>' for value in values)
    kind = 'surface' if shape.is_curved else 'plane'
    return (
        f'<tr><td class="swatch" style="background: rgb({red} {green} {blue})"></td>'
        f'<td>{patch.id}</td><td>{kind}</td>{numbers}</tr>'
    )
