# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes and surfaces as trimmed faces in a STEP file (ISO 10303-21), for CAD programs.

A face is its plane or B-spline surface, bounded by the rings of its outline, holes included. The
parameters of a face are x and y in the frame of its patch: a height field is a NURBS patch to the
bit, because its control points are placed at the Greville abscissae, where x and y are affine in
the parameters. Edges are straight in x and y; on a surface their curves in space follow from it.

Open CASCADE, by cadquery-ocp, writes the file; the header states the time of writing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import DependencyError, FileFormatError
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.models.bspline import knots
from surfel_mapper.models.multi_model import MultiModel, Plane, Surface
from surfel_mapper.models.outlines import local_outline

Array = npt.NDArray[np.float64]

COLOURS = {'plane': (0.78, 0.24, 0.24), 'surface': (0.24, 0.35, 0.78)}
"""Colour of the faces by kind, also the name of their layer."""


EMPTY = b"""ISO-10303-21;
HEADER;
FILE_DESCRIPTION((''),'2;1');
FILE_NAME('','',(''),(''),'','','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN'));
ENDSEC;
DATA;
ENDSEC;
END-ISO-10303-21;
"""
"""A file without shapes, which Open CASCADE does not write."""


def write_step(path: str | Path, model: MultiModel) -> None:
    """
    Write planes and surfaces as trimmed faces, in m; a product for every patch, named by its id.

    Raises
    ------
    FileFormatError
        If the file cannot be written.
    DependencyError
        If cadquery-ocp is not installed.

    """
    ocp = import_ocp()
    content = step_of(ocp, model, str(path)) if model.patches else EMPTY
    with replace_file(path) as file:
        file.write(content)


def step_of(ocp: Any, model: MultiModel, name: str) -> bytes:
    """Return the file of models that have a patch; errors state the name."""
    silence(ocp)
    ocp.STEPControl.STEPControl_Controller.Init_s()  # before it, units cannot be set
    document = ocp.TDocStd.TDocStd_Document(extended(ocp, 'XmlXCAF'))
    ocp.XCAFDoc.XCAFDoc_DocumentTool.SetLengthUnit_s(document, 1.0)  # m
    for patch in model.patches:
        add_patch(ocp, document, patch)
    ocp.Interface.Interface_Static.SetCVal_s('write.step.unit', 'M')
    writer = ocp.STEPCAFControl.STEPCAFControl_Writer()
    writer.Transfer(document)
    with tempfile.TemporaryDirectory() as scratch:
        written = Path(scratch) / 'models.step'
        status = writer.Write(str(written))
        if status != ocp.IFSelect.IFSelect_ReturnStatus.IFSelect_RetDone:
            raise FileFormatError(f'{name}: Open CASCADE cannot write STEP ({status})')
        return written.read_bytes()


def add_patch(ocp: Any, document: Any, patch: Plane) -> None:
    """Add the faces of a patch, named and on the layer of its kind."""
    kind = 'surface' if isinstance(patch, Surface) else 'plane'
    main, tool = document.Main(), ocp.XCAFDoc.XCAFDoc_DocumentTool
    builder, every = ocp.BRep.BRep_Builder(), ocp.TopoDS.TopoDS_Compound()
    builder.MakeCompound(every)
    for face in faces_of(ocp, patch):
        builder.Add(every, face)
    label = tool.ShapeTool_s(main).AddShape(every, False)
    ocp.TDataStd.TDataStd_Name.Set_s(label, extended(ocp, str(patch.id)))
    colour = ocp.Quantity.Quantity_Color(*COLOURS[kind], ocp.Quantity.Quantity_TOC_RGB)
    tool.ColorTool_s(main).SetColor(label, colour, ocp.XCAFDoc.XCAFDoc_ColorSurf)
    tool.LayerTool_s(main).SetLayer(label, extended(ocp, kind))


def faces_of(ocp: Any, patch: Plane) -> Iterator[Any]:
    """Yield a face for every connected part of a patch."""
    surface = surface_of(ocp, patch)
    for outer, holes in parts(local_outline(patch)):
        made = ocp.BRepBuilderAPI.BRepBuilderAPI_MakeFace(
            surface, wire_of(ocp, surface, patch, outer), True
        )
        for hole in holes:
            made.Add(wire_of(ocp, surface, patch, hole))
        face = made.Face()
        ocp.BRepLib.BRepLib.BuildCurves3d_s(face)
        yield face


def surface_of(ocp: Any, patch: Plane) -> Any:
    """Return the untrimmed surface of a patch, its parameters x and y in the frame, m."""
    gp = ocp.gp
    if not isinstance(patch, Surface):
        x_axis, _, normal = (gp.gp_Dir(*axis) for axis in patch.R_patch_map.tolist())
        return ocp.Geom.Geom_Plane(gp.gp_Ax3(gp.gp_Pnt(*patch.mean.tolist()), normal, x_axis))
    field = patch.spline
    local = np.stack([*np.meshgrid(*field.greville(), indexing='ij'), field.control], axis=-1)
    points = local @ patch.R_patch_map + patch.mean
    poles = ocp.TColgp.TColgp_Array2OfPnt(1, points.shape[0], 1, points.shape[1])
    for i, j in np.ndindex(points.shape[:2]):
        poles.SetValue(i + 1, j + 1, gp.gp_Pnt(*points[i, j].tolist()))
    every = [knots_of(ocp, patch, axis) for axis in range(2)]
    (x, x_times), (y, y_times) = every
    return ocp.Geom.Geom_BSplineSurface(poles, x, y, x_times, y_times, *field.degrees)


def knots_of(ocp: Any, patch: Surface, axis: int) -> tuple[Any, Any]:
    """Return the distinct knots along an axis, m, and how often each occurs."""
    field = patch.spline
    number, degree = field.control.shape[axis], field.degrees[axis]
    values, times = np.unique(knots(number - 2, degree), return_counts=True)
    low = float(field.origin[axis]) - 0.5 * field.pitch_m
    found = ocp.TColStd.TColStd_Array1OfReal(1, len(values))
    counts = ocp.TColStd.TColStd_Array1OfInteger(1, len(values))
    for k, (value, count) in enumerate(zip(values.tolist(), times.tolist(), strict=True), 1):
        found.SetValue(k, low + value * (number - 1) * field.pitch_m)
        counts.SetValue(k, count)
    return found, counts


def wire_of(ocp: Any, surface: Any, patch: Plane, ring: Array) -> Any:
    """Return the closed wire along a ring (M, 2) on a surface."""
    build, gp = ocp.BRepBuilderAPI, ocp.gp
    corners = [
        build.BRepBuilderAPI_MakeVertex(gp.gp_Pnt(*point)).Vertex()
        for point in patch.lifted(ring).tolist()
    ]
    wire = build.BRepBuilderAPI_MakeWire()
    steps = np.roll(ring, -1, axis=0) - ring
    lengths = np.linalg.norm(steps, axis=1)
    for k, (start, step, length) in enumerate(
        zip(ring.tolist(), steps.tolist(), lengths.tolist(), strict=True)
    ):
        line = ocp.Geom2d.Geom2d_Line(gp.gp_Pnt2d(*start), gp.gp_Dir2d(*step))
        ends = corners[k], corners[(k + 1) % len(corners)]
        wire.Add(build.BRepBuilderAPI_MakeEdge(line, surface, *ends, 0.0, length).Edge())
    return wire.Wire()


def parts(rings: Sequence[Array]) -> list[tuple[Array, list[Array]]]:
    """
    Return each outer ring (M, 2) with the holes in it.

    A hole belongs to the smallest outer ring that is larger and contains one of its corners. The
    mean of the corners may lie in an island, or outside of all outer rings if the hole is bent.
    """
    outer = [ring for ring in rings if signed_area(ring) > 0.0]
    found: list[tuple[Array, list[Array]]] = [(ring, []) for ring in outer]
    areas = [signed_area(ring) for ring in outer]
    for hole in rings:
        if (area := signed_area(hole)) <= 0.0:
            larger = [k for k, each in enumerate(areas) if each > -area]
            around = [k for k in larger if is_inside(hole[0], outer[k])]
            found[min(around, key=areas.__getitem__)][1].append(hole)
    return found


def is_inside(point: Array, ring: Array) -> bool:
    """Return whether a point (2,) is inside a ring (M, 2)."""
    (x, y), (next_x, next_y) = (ring - point).T, (np.roll(ring, -1, axis=0) - point).T
    crosses = (y > 0.0) != (next_y > 0.0)
    with np.errstate(divide='ignore', invalid='ignore'):
        at = x - y * (next_x - x) / (next_y - y)
    return bool((crosses & (at > 0.0)).sum() % 2)


def signed_area(ring: Array) -> float:
    """Return the area within a ring (n, 2), negative if it is clockwise, as holes are."""
    x, y = ring.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def silence(ocp: Any) -> None:
    """Keep Open CASCADE from printing its progress; failures are still printed."""
    for printer in ocp.Message.Message.DefaultMessenger_s().Printers():
        printer.SetTraceLevel(ocp.Message.Message_Gravity.Message_Fail)


def extended(ocp: Any, text: str) -> Any:
    """Return a text as Open CASCADE has it."""
    return ocp.TCollection.TCollection_ExtendedString(text)


def import_ocp() -> Any:
    """Return the package OCP with the modules that are used here."""
    try:
        import OCP
        import OCP.BRep
        import OCP.BRepBuilderAPI
        import OCP.BRepLib
        import OCP.Geom
        import OCP.Geom2d
        import OCP.gp
        import OCP.IFSelect
        import OCP.Interface
        import OCP.Message
        import OCP.Quantity
        import OCP.STEPCAFControl
        import OCP.STEPControl
        import OCP.TColgp
        import OCP.TCollection
        import OCP.TColStd
        import OCP.TDataStd
        import OCP.TDocStd
        import OCP.TopoDS
        import OCP.XCAFDoc
    except ImportError as error:
        raise DependencyError(
            f'OCP cannot be loaded ({error}). It writes STEP; install it with '
            "`pip install 'surfel_mapper[step]'` or `pip install cadquery-ocp-novtk`"
        ) from error
    return OCP
