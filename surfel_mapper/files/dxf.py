# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes and surfaces as DXF, for CAD: outlines as closed polylines, and what they enclose as meshes.

DXF of AutoCAD 2000 and later, in metres, which its header says. Written by ezdxf, which knows
what readers expect beside the entities: DXF by hand is easily one that some program refuses.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from surfel_mapper.errors import DependencyError
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.models.multi_model import MultiModel
from surfel_mapper.models.shapes import shape_of

LAYERS = {
    'plane_outlines': 1,
    'planes': 8,
    'surface_outlines': 5,
    'surfaces': 8,
}
"""Layers and their colours: red, grey, blue, grey."""


def write_dxf(path: str | Path, model: MultiModel) -> None:
    """
    Write planes and surfaces, each kind on two layers: outlines, and faces.

    Raises
    ------
    FileFormatError
        If the file cannot be written.
    DependencyError
        If ezdxf is not installed.

    """
    ezdxf = import_ezdxf()
    drawing = ezdxf.new('R2000', units=ezdxf.units.M)
    for layer, color in LAYERS.items():
        drawing.layers.add(layer, color=color)
    space = drawing.modelspace()
    for patch in model.patches:
        shape = shape_of(patch)
        kind = 'surface' if shape.is_curved else 'plane'
        for ring in shape.rings:
            attributes = {'layer': f'{kind}_outlines'}
            space.add_polyline3d(ring.tolist(), close=True, dxfattribs=attributes)
        with space.add_mesh(dxfattribs={'layer': f'{kind}s'}).edit_data() as mesh:
            mesh.vertices, mesh.faces = shape.vertices.tolist(), shape.faces.tolist()
    text = io.StringIO()
    drawing.write(text)
    with replace_file(path) as file:
        file.write(text.getvalue().encode())


def import_ezdxf() -> Any:
    """Return ezdxf."""
    try:
        import ezdxf
    except ImportError as error:
        raise DependencyError(
            f'ezdxf cannot be loaded ({error}). It writes DXF; install it with '
            "`pip install 'surfel_mapper[formats]'` or `pip install ezdxf`"
        ) from error
    return ezdxf
