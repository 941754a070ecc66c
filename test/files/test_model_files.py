# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""JSON, Parquet, OBJ and DXF files agree with the models."""

from __future__ import annotations

from dataclasses import replace
import json

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.model_files import (
    LAYERS,
    write_dxf,
    write_json,
    write_models,
    write_obj,
    write_parquet,
)
from surfel_mapper.models import fit
from surfel_mapper.models.outlines import areas
from surfel_mapper.models.shapes import shape_of
from test import extras
from test.models.scenes import A, room, VIEW


@pytest.fixture(scope='module')
def model():
    return fit(room(160, 120)[0], ModelsConfig(voxel_size_m=A), VIEW)


def test_json_holds_planes_surfaces_and_gaussians(model, tmp_path):
    write_json(tmp_path / 'models.json', model)
    found = json.loads((tmp_path / 'models.json').read_text())
    assert [p['id'] for p in found['planes']] == [p.id for p in model.planes]
    assert [s['id'] for s in found['surfaces']] == [s.id for s in model.surfaces]
    assert len(found['gaussians']) == len(model.gaussians) > 0
    for content, plane in zip(found['planes'], model.planes, strict=True):
        ring = np.array(content['outline'][0])
        np.testing.assert_allclose(ring @ content['normal'] + content['offset_m'], 0.0, atol=1e-9)
        assert content['mean'] == plane.mean.tolist()
    control = np.array(found['surfaces'][0]['control'])
    assert (control == model.surfaces[0].spline.control).all()


def test_parquet_has_a_row_for_every_primitive(model, tmp_path):
    parquet = extras.load('pyarrow.parquet')
    write_parquet(tmp_path / 'models.parquet', model)
    table = parquet.read_table(tmp_path / 'models.parquet').to_pydict()
    kinds = ['plane'] * len(model.planes) + ['surface'] * len(model.surfaces)
    assert table['kind'] == kinds + ['gaussian'] * len(model.gaussians)
    assert sum(table['num_points']) == model.num_thinned
    assert table['cov_xy'][0] == model.planes[0].covariance[0, 1]
    assert np.isnan(table['area_m2'][-1])


def test_obj_has_an_object_for_every_patch_and_faces_within_its_vertices(model, tmp_path):
    write_obj(tmp_path / 'models.obj', model)
    lines = (tmp_path / 'models.obj').read_text().splitlines()
    names = [line[2:] for line in lines if line.startswith('o ')]
    assert names == [f'plane_{p.id}' for p in model.planes] + [
        f'surface_{s.id}' for s in model.surfaces
    ]
    num_vertices = 0
    for line in lines:
        if line.startswith('v '):
            num_vertices += 1
        elif line.startswith('f '):
            assert all(1 <= int(n) <= num_vertices for n in line.split()[1:])


def test_ids_and_versions_of_live_models_are_kept(model, tmp_path):
    parquet = extras.load('pyarrow.parquet')
    live = replace(
        model,
        planes=[replace(plane, id=plane.id + 1000) for plane in model.planes],
        gaussians=replace(model.gaussians, id=model.gaussians.id + 2000),
    )
    ids = [p.id for p in live.patches] + live.gaussians.id.tolist()
    versions = {number: number % 7 for number in ids}
    written = write_models(tmp_path, live, ('json', 'parquet'), versions)
    assert [path.name for path in written] == ['models.json', 'models.parquet']
    found = json.loads(written[0].read_text())
    for kind in ('planes', 'surfaces', 'gaussians'):
        assert all(item['version'] == item['id'] % 7 for item in found[kind])
    table = parquet.read_table(written[1]).to_pydict()
    assert table['id'] == ids
    assert table['version'] == [number % 7 for number in ids]


def test_empty_models_are_written(tmp_path):
    empty = fit(np.empty((0, 3)))
    write_json(tmp_path / 'a.json', empty)
    write_obj(tmp_path / 'a.obj', empty)
    assert json.loads((tmp_path / 'a.json').read_text())['planes'] == []


def test_a_missing_directory_is_refused(model, tmp_path):
    with pytest.raises(FileFormatError, match='none'):
        write_json(tmp_path / 'none' / 'models.json', model)


@pytest.fixture(scope='module')
def ezdxf():
    return extras.load('ezdxf')


@pytest.fixture(scope='module')
def written(tmp_path_factory, ezdxf):
    model = fit(room(160, 120)[0], ModelsConfig(voxel_size_m=A), VIEW)
    path = tmp_path_factory.mktemp('dxf') / 'models.dxf'
    write_dxf(path, model)
    return model, ezdxf.readfile(path)


def test_the_drawing_is_in_metres_and_passes_the_audit(ezdxf, written):
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


def test_empty_models_give_an_empty_drawing(ezdxf, tmp_path):
    write_dxf(tmp_path / 'a.dxf', fit(np.empty((0, 3))))
    assert len(ezdxf.readfile(tmp_path / 'a.dxf').modelspace()) == 0


def test_dxf_in_a_missing_directory_is_refused(tmp_path):
    extras.load('ezdxf')
    with pytest.raises(FileFormatError, match='none'):
        write_dxf(tmp_path / 'none' / 'a.dxf', fit(np.empty((0, 3))))
