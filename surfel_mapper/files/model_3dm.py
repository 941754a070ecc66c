# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes and surfaces as NURBS in a Rhino file (3dm), which CAD programs convert to STEP.

A B-spline height field is a NURBS patch to the bit: its control points are placed at the Greville
abscissae, where x and y are affine in the parameters. The patch covers the whole grid; outlines
are curves of their own, because openNURBS writes trimmed surfaces from Python for planes only.
Planes are trimmed by their outer rings; holes are in outlines and faces.

openNURBS, by rhino3dm, writes the file; it states times and random ids, so that two files of the
same models differ.
"""

from __future__ import annotations

from pathlib import Path
import tempfile
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import DependencyError
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.models.bspline import knots
from surfel_mapper.models.multi_model import MultiModel, Plane, Surface
from surfel_mapper.models.outlines import local_outline
from surfel_mapper.models.shapes import shape_of

Array = npt.NDArray[np.float64]

LAYERS = {
    'planes': (200, 60, 60),
    'plane_outlines': (120, 0, 0),
    'plane_faces': (170, 170, 170),
    'surfaces': (60, 90, 200),
    'surface_outlines': (0, 0, 120),
    'surface_faces': (170, 170, 170),
}
"""Layers and their colours: NURBS, outlines with holes, and meshes within these."""

ARCHIVE_VERSION = 7
"""Version of the archive: read by Rhino 7 and later, FreeCAD and Blender's import."""


def write_3dm(path: str | Path, model: MultiModel) -> None:
    """
    Write planes and surfaces as NURBS, outlines and faces, each on a layer by kind, in m.

    The name of every object is the id of its patch.

    Raises
    ------
    FileFormatError
        If the file cannot be written.
    DependencyError
        If rhino3dm is not installed.

    """
    rhino3dm = import_rhino3dm()
    drawing = rhino3dm.File3dm()
    drawing.Settings.ModelUnitSystem = rhino3dm.UnitSystem.Meters
    for name, (red, green, blue) in LAYERS.items():
        layer = rhino3dm.Layer()
        layer.Name, layer.Color = name, (red, green, blue, 255)
        drawing.Layers.Add(layer)
    for patch in model.patches:
        add_patch(rhino3dm, drawing, patch)
    with tempfile.TemporaryDirectory() as scratch:
        written = Path(scratch) / 'models.3dm'
        drawing.Write(str(written), ARCHIVE_VERSION)
        content = written.read_bytes()
    with replace_file(path) as file:
        file.write(content)


def add_patch(rhino3dm: Any, drawing: Any, patch: Plane) -> None:
    """Add the NURBS, outlines and faces of a patch."""
    kind = 'surface' if isinstance(patch, Surface) else 'plane'

    def attributes(layer: str) -> Any:
        found = rhino3dm.ObjectAttributes()
        found.LayerIndex, found.Name = list(LAYERS).index(layer), str(patch.id)
        return found

    if isinstance(patch, Surface):
        drawing.Objects.AddSurface(nurbs_surface(rhino3dm, patch), attributes('surfaces'))
    for xy in local_outline(patch):
        curve = ring_curve(rhino3dm, patch.lifted(xy))
        drawing.Objects.AddCurve(curve, attributes(f'{kind}_outlines'))
        if kind == 'plane' and signed_area(xy) > 0.0:
            drawing.Objects.AddBrep(
                rhino3dm.Brep.CreateTrimmedPlane(plane_of(rhino3dm, patch), curve),
                attributes('planes'),
            )
    shape, mesh = shape_of(patch), rhino3dm.Mesh()
    for vertex in shape.vertices.tolist():
        mesh.Vertices.Add(*vertex)
    for face in shape.faces.tolist():
        mesh.Faces.AddFace(*face)
    mesh.Normals.ComputeNormals()
    drawing.Objects.AddMesh(mesh, attributes(f'{kind}_faces'))


def nurbs_surface(rhino3dm: Any, patch: Surface) -> Any:
    """Return the height field of a patch as a NURBS surface, parameters in [0, 1]."""
    field = patch.spline
    (num_x, num_y), (degree_x, degree_y) = field.control.shape, field.degrees
    surface = rhino3dm.NurbsSurface.Create(3, False, degree_x + 1, degree_y + 1, num_x, num_y)
    for number, degree, to in (
        (num_x, degree_x, surface.KnotsU),
        (num_y, degree_y, surface.KnotsV),
    ):
        # openNURBS leaves out the first and last knot
        for i, knot in enumerate(knots(number - 2, degree)[1:-1].tolist()):
            to[i] = knot
    x, y = field.greville()
    local = np.stack([*np.meshgrid(x, y, indexing='ij'), field.control], axis=-1)
    points = local @ patch.R_patch_map + patch.mean
    for i in range(num_x):
        for j in range(num_y):
            surface.Points[i, j] = rhino3dm.Point4d(*points[i, j].tolist(), 1.0)
    return surface


def plane_of(rhino3dm: Any, patch: Plane) -> Any:
    """Return the plane of a patch in its frame."""
    origin, (x_axis, y_axis, _) = patch.mean.tolist(), patch.R_patch_map.tolist()
    return rhino3dm.Plane(
        rhino3dm.Point3d(*origin), rhino3dm.Vector3d(*x_axis), rhino3dm.Vector3d(*y_axis)
    )


def ring_curve(rhino3dm: Any, ring: Array) -> Any:
    """Return a closed polyline through points (n, 3)."""
    closed = [*ring.tolist(), ring[0].tolist()]
    return rhino3dm.PolylineCurve(rhino3dm.Point3dList([rhino3dm.Point3d(*p) for p in closed]))


def signed_area(ring: Array) -> float:
    """Return the area within a ring (n, 2), negative if it is clockwise, as holes are."""
    x, y = ring.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def import_rhino3dm() -> Any:
    """Return rhino3dm."""
    try:
        import rhino3dm
    except ImportError as error:
        raise DependencyError(
            f'rhino3dm cannot be loaded ({error}). It writes NURBS; install it with '
            "`pip install 'surfel_mapper[nurbs]'` or `pip install rhino3dm`"
        ) from error
    return rhino3dm
