# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Models as NURBS, read back by openNURBS: the same surfaces, outlines and faces."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.model_3dm import LAYERS, write_3dm
from surfel_mapper.models import fit
from surfel_mapper.models.shapes import shape_of
from test.models.scenes import A, room, VIEW

rhino3dm = pytest.importorskip('rhino3dm', reason='rhino3dm is not installed (extra nurbs)')


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    points = room(320, 240)[0] + np.float32([30.0, -20.0, 5.0])
    model = fit(points, ModelsConfig(voxel_size_m=A), VIEW + np.array([30.0, -20.0, 5.0]))
    path = tmp_path_factory.mktemp('nurbs') / 'models.3dm'
    write_3dm(path, model)
    return model, rhino3dm.File3dm.Read(str(path))


def on_layer(drawing, layer):
    """Return name and geometry of the objects of a layer."""
    number = list(LAYERS).index(layer)
    return [
        (int(one.Attributes.Name), one.Geometry)
        for one in drawing.Objects
        if one.Attributes.LayerIndex == number
    ]


def test_the_file_is_in_metres_with_valid_objects_on_named_layers(written):
    _, drawing = written
    assert drawing.Settings.ModelUnitSystem == rhino3dm.UnitSystem.Meters
    assert [layer.Name for layer in drawing.Layers] == list(LAYERS)
    assert all(one.Geometry.IsValid for one in drawing.Objects)


def test_nurbs_surfaces_equal_the_height_fields(written):
    model, drawing = written
    found = dict(on_layer(drawing, 'surfaces'))
    assert model.surfaces
    assert set(found) == {surface.id for surface in model.surfaces}
    for surface in model.surfaces:
        nurbs = found[surface.id]
        low, high = nurbs.Domain(0), nurbs.Domain(1)
        assert (low.T0, low.T1, high.T0, high.T1) == (0.0, 1.0, 0.0, 1.0)
        places = np.random.default_rng(1).uniform(0.0, 1.0, (50, 2))
        read = np.array([[p.X, p.Y, p.Z] for p in (nurbs.PointAt(*uv) for uv in places.tolist())])
        # the parameters are affine over the cells and half a cell beyond
        cells = np.array(surface.grid.filled.shape)
        xy = surface.grid.origin + surface.grid.pitch_m * (places * (cells + 1) - 0.5)
        np.testing.assert_allclose(read, surface.lifted(xy), atol=1e-9)
        normal = nurbs.NormalAt(*places[0].tolist())
        expected = surface.normals(xy[:1])[0]
        np.testing.assert_allclose([normal.X, normal.Y, normal.Z], expected, atol=1e-9)


def test_planes_are_trimmed_by_their_outer_rings(written):
    model, drawing = written
    found = on_layer(drawing, 'planes')
    assert {number for number, _ in found} == {plane.id for plane in model.planes}
    for number, brep in found:
        (plane,) = (one for one in model.planes if one.id == number)
        assert len(brep.Faces) == 1
        read = np.array([[v.Location.X, v.Location.Y, v.Location.Z] for v in brep.Vertices])
        assert len(brep.Edges) == len(read)  # one loop
        rings = [ring for ring in shape_of(plane).rings if len(ring) == len(read)]
        apart = [np.linalg.norm(read[:, None] - ring, axis=2).min(axis=1).max() for ring in rings]
        assert min(apart) < 1e-9


@pytest.mark.parametrize('kind', ['plane', 'surface'])
def test_outlines_and_faces_are_those_of_the_shapes(written, kind):
    model, drawing = written
    curves, meshes = on_layer(drawing, f'{kind}_outlines'), on_layer(drawing, f'{kind}_faces')
    for patch in model.planes if kind == 'plane' else model.surfaces:
        shape = shape_of(patch)
        read = [curve for number, curve in curves if number == patch.id]
        for ring, curve in zip(shape.rings, read, strict=True):
            assert curve.IsClosed
            points = [curve.Point(i) for i in range(curve.PointCount - 1)]
            np.testing.assert_allclose([[p.X, p.Y, p.Z] for p in points], ring, atol=1e-12)
        (mesh,) = (mesh for number, mesh in meshes if number == patch.id)
        assert len(mesh.Faces) == len(shape.faces)
        vertex = mesh.Vertices[0]  # float32 in the file
        np.testing.assert_allclose([vertex.X, vertex.Y, vertex.Z], shape.vertices[0], atol=1e-5)


def test_empty_models_give_a_file_without_objects(tmp_path):
    write_3dm(tmp_path / 'a.3dm', fit(np.empty((0, 3))))
    assert len(rhino3dm.File3dm.Read(str(tmp_path / 'a.3dm')).Objects) == 0


def test_a_missing_directory_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match='none'):
        write_3dm(tmp_path / 'none' / 'a.3dm', fit(np.empty((0, 3))))
