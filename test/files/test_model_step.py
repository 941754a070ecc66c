# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Models as STEP, read back by Open CASCADE: the same surfaces, trimmed by the same outlines."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.model_step import parts, signed_area, write_step
from surfel_mapper.models import fit, Surface
from surfel_mapper.models.outlines import local_outline
from test import extras
from test.models.scenes import A, room, VIEW

OCP = extras.load('OCP')

SHIFT = np.array([30.0, -20.0, 5.0])


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    """Return models, and text and products of their file: name, layer and faces of each."""
    points = room(320, 240)[0] + SHIFT.astype(np.float32)
    model = fit(points, ModelsConfig(voxel_size_m=A), VIEW + SHIFT)
    path = tmp_path_factory.mktemp('step') / 'models.step'
    write_step(path, model)
    return model, path.read_text(), products(path)


def products(path):
    from OCP.STEPCAFControl import STEPCAFControl_Reader
    from OCP.TCollection import TCollection_ExtendedString
    from OCP.TDataStd import TDataStd_Name
    from OCP.TDF import TDF_LabelSequence
    from OCP.TDocStd import TDocStd_Document
    from OCP.XCAFDoc import XCAFDoc_DocumentTool

    document = TDocStd_Document(TCollection_ExtendedString('XmlXCAF'))
    XCAFDoc_DocumentTool.SetLengthUnit_s(document, 1.0)
    reader = STEPCAFControl_Reader()
    reader.SetLayerMode(True)
    reader.ReadFile(str(path))
    reader.Transfer(document)
    shapes = XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    layers = XCAFDoc_DocumentTool.LayerTool_s(document.Main())
    labels = TDF_LabelSequence()
    shapes.GetFreeShapes(labels)
    found = {}
    for k in range(1, labels.Length() + 1):
        label, name = labels.Value(k), TDataStd_Name()
        assert label.FindAttribute(TDataStd_Name.GetID_s(), name)
        parts_of = TDF_LabelSequence()
        shapes.GetSubShapes_s(label, parts_of)  # the format has layers of parts
        layer = layers.GetLayers(parts_of.Value(1)).Value(1).ToExtString()
        found[int(name.Get().ToExtString())] = layer, faces(shapes.GetShape_s(label))
    return found


def faces(shape):
    return [OCP.TopoDS.TopoDS.Face_s(face) for face in explored(shape, 'FACE')]


def explored(shape, kind):
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer

    explorer = TopExp_Explorer(shape, getattr(TopAbs_ShapeEnum, f'TopAbs_{kind}'))
    while explorer.More():
        yield explorer.Current()
        explorer.Next()


def area_m2(face):
    from OCP.BRepGProp import BRepGProp
    from OCP.GProp import GProp_GProps

    found = GProp_GProps()
    BRepGProp.SurfaceProperties_s(face, found, 1e-6)
    return found.Mass()


def outline_area_m2(patch):
    """Return the area inside the outline of a patch, by the midpoints of small squares."""
    from matplotlib.path import Path  # seconds to import

    total, step = 0.0, patch.grid.pitch_m / 40
    for outer, holes in parts(local_outline(patch)):
        low, high = outer.min(axis=0), outer.max(axis=0)
        xy = low + step * (np.argwhere(np.ones(((high - low) / step).astype(int) + 1)) + 0.5)
        xy = xy[Path(outer).contains_points(xy)]
        for hole in holes:
            xy = xy[~Path(hole).contains_points(xy)]
        if isinstance(patch, Surface):
            total += float((1.0 / (patch.normals(xy) @ patch.normal)).sum()) * step**2
        else:
            total += len(xy) * step**2
    return total


def test_every_patch_is_a_named_product_in_metres_with_valid_faces(written):
    from OCP.BRepCheck import BRepCheck_Analyzer

    model, text, found = written
    assert 'SI_UNIT($,.METRE.)' in text
    assert set(found) == {patch.id for patch in model.patches}
    for patch in model.patches:
        layer, every = found[patch.id]
        assert layer == ('surface' if patch in model.surfaces else 'plane')
        assert len(every) == len(parts(local_outline(patch)))
        assert all(BRepCheck_Analyzer(face).IsValid() for face in every)


def test_surfaces_equal_the_height_fields(written):
    from OCP.BRep import BRep_Tool

    model, _, found = written
    assert model.surfaces
    for surface in model.surfaces:
        nurbs = BRep_Tool.Surface_s(found[surface.id][1][0])
        xy = np.random.default_rng(1).permutation(surface.grid.samples(0.25 * A))[:100]
        read = np.array([[p.X(), p.Y(), p.Z()] for p in (nurbs.Value(*at) for at in xy.tolist())])
        np.testing.assert_allclose(read, surface.lifted(xy), atol=1e-9)


def test_faces_are_trimmed_by_the_outlines(written):
    from OCP.BRep import BRep_Tool

    model, _, found = written
    for patch in model.patches:
        rings = local_outline(patch)
        every = found[patch.id][1]
        wires = [wire for face in every for wire in explored(face, 'WIRE')]
        assert len(wires) == len(rings)
        corners = [
            BRep_Tool.Pnt_s(OCP.TopoDS.TopoDS.Vertex_s(vertex))
            for wire in wires
            for vertex in explored(wire, 'VERTEX')
        ]
        read = np.unique(np.round([[p.X(), p.Y(), p.Z()] for p in corners], 7), axis=0)
        expected = np.unique(np.round(patch.lifted(np.concatenate(rings)), 7), axis=0)
        assert len(read) == len(expected)
        apart = np.linalg.norm(read[:, None] - expected, axis=2)
        assert apart.min(axis=1).max() < 1e-6
        assert apart.min(axis=0).max() < 1e-6


def test_areas_are_those_inside_the_outlines(written):
    model, _, found = written
    for plane in model.planes:
        expected = sum(signed_area(ring) for ring in local_outline(plane))
        assert sum(map(area_m2, found[plane.id][1])) == pytest.approx(expected, rel=1e-6)
    for surface in model.surfaces:
        expected = outline_area_m2(surface)
        assert sum(map(area_m2, found[surface.id][1])) == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize('bend', [0.0, 0.5])
def test_holes_stay_holes(tmp_path, bend):
    x, y = np.mgrid[-1.0:1.0:0.01, -1.0:1.0:0.01]
    points = np.stack([x, y, bend * x * x], -1)[np.hypot(x, y) > 0.4]
    model = fit(points, ModelsConfig(voxel_size_m=A), (0.0, 0.0, 5.0))
    (patch,) = model.patches
    write_step(tmp_path / 'a.step', model)
    ((_, (face,)),) = products(tmp_path / 'a.step').values()
    assert len([*explored(face, 'WIRE')]) == 2
    assert area_m2(face) == pytest.approx(outline_area_m2(patch), rel=5e-3)
    whole = 4.0 if not bend else 2.0 * (np.sqrt(2.0) + np.arcsinh(1.0))
    assert area_m2(face) == pytest.approx(whole - 0.16 * np.pi, rel=0.05)


X, Y = np.mgrid[-2.0:2.0:0.01, -2.0:2.0:0.01]
SIDE = np.maximum(np.abs(X), np.abs(Y))
"""Half the side of the square around the origin through each point, m."""

U_SHAPE = ~((np.abs(X) < 0.6) & (Y > -0.8))
U_HOLE = (SIDE < 1.6) & ~((np.abs(X) < 1.0) & (Y > -1.2))


@pytest.mark.parametrize(
    ('covered', 'areas'),
    [
        ((SIDE > 1.0) | (SIDE < 0.5), [1.0**2, 4.0**2 - 2.0**2]),
        (U_SHAPE & ~U_HOLE, [4.0**2 - 1.2 * 2.8 - (3.2**2 - 2.0 * 2.8)]),
    ],
    ids=['island in a hole', 'hole with its middle outside'],
)
def test_holes_belong_to_the_part_around_them(tmp_path, covered, areas):
    from OCP.BRepCheck import BRepCheck_Analyzer

    points = np.stack([X, Y, np.zeros_like(X)], -1)[covered]
    write_step(tmp_path / 'a.step', fit(points, ModelsConfig(voxel_size_m=A), (0.0, 0.0, 5.0)))
    ((_, every),) = products(tmp_path / 'a.step').values()
    assert all(BRepCheck_Analyzer(face).IsValid() for face in every)
    # outlines are up to half a voxel outside of the points: 0.6 m^2 along 38 m, of 8 m^2
    assert sorted(map(area_m2, every)) == pytest.approx(areas, rel=0.1)


def test_empty_models_give_a_file_without_faces(tmp_path):
    write_step(tmp_path / 'a.step', fit(np.empty((0, 3))))
    assert 'ADVANCED_FACE' not in (tmp_path / 'a.step').read_text()


def test_a_missing_directory_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match='none'):
        write_step(tmp_path / 'none' / 'a.step', fit(np.empty((0, 3))))


def test_nothing_is_printed(tmp_path, capfd):
    write_step(tmp_path / 'a.step', fit(room(80, 60)[0], ModelsConfig(voxel_size_m=A), VIEW))
    assert capfd.readouterr() == ('', '')
