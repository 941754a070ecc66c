# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""DXF: what ezdxf reads again, and finds no fault with, is what the models are."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.dxf import LAYERS, write_dxf
from surfel_mapper.models import fit
from surfel_mapper.models.filling import areas
from surfel_mapper.models.shapes import shape_of
from test.models.scenes import A, room, VIEW

ezdxf = pytest.importorskip('ezdxf', reason='ezdxf is not installed (extra formats)')


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    model = fit(room(160, 120)[0], ModelsConfig(voxel_size_m=A), VIEW)
    path = tmp_path_factory.mktemp('dxf') / 'models.dxf'
    write_dxf(path, model)
    return model, ezdxf.readfile(path)


def test_the_drawing_is_in_metres_and_without_a_fault(written):
    drawing = written[1]
    assert drawing.units == ezdxf.units.M
    audit = drawing.audit()
    assert not audit.errors
    assert not audit.fixes
    assert set(LAYERS) <= {layer.dxf.name for layer in drawing.layers}


@pytest.mark.parametrize('kind', ['plane', 'surface'])
def test_outlines_are_closed_rings_and_faces_have_their_area(written, kind):
    model, drawing = written
    patches = model.planes if kind == 'plane' else model.surfaces
    shapes = [shape_of(patch) for patch in patches]
    space = drawing.modelspace()
    lines = list(space.query(f'POLYLINE[layer=="{kind}_outlines"]'))
    rings = [ring for shape in shapes for ring in shape.rings]
    assert len(lines) == len(rings) > 0
    for line, ring in zip(lines, rings, strict=True):
        assert line.is_closed
        assert np.array([*line.points()]) == pytest.approx(ring, abs=1e-9)
    meshes = list(space.query(f'MESH[layer=="{kind}s"]'))
    for mesh, shape in zip(meshes, shapes, strict=True):
        corners = np.array([*mesh.vertices])[np.array([*mesh.faces])]
        assert areas(corners).sum() == pytest.approx(shape.area_m2)


def test_nothing_is_a_drawing_of_nothing(tmp_path):
    write_dxf(tmp_path / 'a.dxf', fit(np.empty((0, 3))))
    assert len(ezdxf.readfile(tmp_path / 'a.dxf').modelspace()) == 0


def test_a_directory_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match='none'):
        write_dxf(tmp_path / 'none' / 'a.dxf', fit(np.empty((0, 3))))
