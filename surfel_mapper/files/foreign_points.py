# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Points in formats that libraries read: E57, VTK, OBJ, and the feather files of Argoverse 2.

E57 has several scans, each with its pose: ``read_e57`` returns all in the frame of the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError, refusing
from surfel_mapper.files.point_columns import Columns, NORMALS
from surfel_mapper.libraries import library
from surfel_mapper.mapping.channels import RGB

E57_COLUMNS = {
    **{f'cartesian{axis.upper()}': axis for axis in 'xyz'},
    'intensity': 'intensity',
    **{f'color{name.capitalize()}': name for name in RGB},
}

TAIL_BYTES = 1 << 16
"""End of an OBJ file in which faces are looked for, bytes."""


def decoder(name: str, path: str | Path, extra: str) -> Any:
    """Return the module that reads a file, of an extra of this package; see library."""
    purpose = f'reads {Path(path).suffix} (.ply and .pcd need no package)'
    return library(name, purpose, f"'surfel_mapper[{extra}]'")


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Turn errors of a decoder that opens a file by its name into a FileFormatError."""
    try:
        with refusing(path), open_regular(path):  # a pipe would block
            yield
    except FileFormatError as error:
        if error.__cause__ is None:  # our own, which says more
            raise
        formats = f'expected {path.suffix}, or points as .ply, .pcd, .las, .xyz, .npy'
        raise FileFormatError(f'{error}; {formats}') from error


def read_e57(path: str | Path) -> Columns:
    """Return the points of all scans of an E57 file, in its frame; see decoding."""
    path = Path(path)
    pye57 = decoder('pye57', path, 'clouds')

    with decoding(path), pye57.E57(str(path)) as file:
        scans = [e57_scan(file, number) for number in range(file.scan_count)]
    if not scans:
        raise FileFormatError(f'{path}: no scans in it')
    names = [name for name in scans[0] if all(name in scan for scan in scans)]
    return {name: np.concatenate([scan[name] for scan in scans]) for name in names}


def e57_scan(file: Any, number: int) -> Columns:
    """Return the columns of a scan in an open E57, in the frame of the file."""
    columns = file.read_scan(number, intensity=True, colors=True, ignore_missing_fields=True)
    return {E57_COLUMNS[name]: columns[name] for name in E57_COLUMNS if name in columns}


def read_vtk(path: str | Path) -> Columns:
    """Return the points of a VTK file, legacy or XML, and their scalars; see decoding."""
    path = Path(path)
    is_legacy = path.suffix.lower() == '.vtk'
    module = decoder(f'vtkmodules.vtkIO{"Legacy" if is_legacy else "XML"}', path, 'clouds')
    numpy_of = decoder('vtkmodules.util.numpy_support', path, 'clouds').vtk_to_numpy
    decoder('vtkmodules.vtkCommonCore', path, 'clouds').vtkObject.GlobalWarningDisplayOff()
    decoder('vtkmodules.vtkCommonDataModel', path, 'clouds')
    names = {'.vtk': 'vtkGenericDataObjectReader', '.vtp': 'vtkXMLPolyDataReader'}
    with decoding(path):
        reader = getattr(module, names.get(path.suffix.lower(), 'vtkXMLUnstructuredGridReader'))()
        reader.SetFileName(str(path))
        reader.Update()
        data = reader.GetOutput()
        points = data.GetPoints() if data is not None and data.IsA('vtkPointSet') else None
        if points is None or reader.GetErrorCode():
            raise FileFormatError(f'{path}: no points that VTK can read')
        table = np.array(numpy_of(points.GetData()))
        columns = dict(zip('xyz', table.T, strict=True))
        attributes = data.GetPointData()
        arrays = [attributes.GetArray(at) for at in range(attributes.GetNumberOfArrays())]
        for at, array in enumerate(arrays):
            if array is not None and array.GetNumberOfTuples() == len(table):
                columns |= vtk_columns(array.GetName() or f'array_{at}', np.array(numpy_of(array)))
    return columns


def vtk_columns(name: str, values: npt.NDArray[Any]) -> Columns:
    """Return an attribute as columns: scalars, colours, or normals."""
    if values.ndim == 1:
        return {name: values}
    if values.shape[1] in (3, 4) and values.dtype == np.uint8:
        return dict(zip(RGB, values.T[:3], strict=True))
    if name.lower() in ('normals', 'normal') and values.shape[1] == 3:
        return dict(zip(NORMALS, values.T, strict=True))
    return {f'{name}_{at}': column for at, column in enumerate(values.T)}


def has_faces(path: Path) -> bool:
    """Return whether an OBJ file ends with faces, which follow the vertices."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        file.seek(max(size - TAIL_BYTES, 0))
        return path.suffix.lower() == '.obj' and b'\nf ' in file.read()


def read_obj(path: str | Path) -> Columns:
    """Return the vertices of an OBJ file without faces, and their colours; see decoding."""
    path = Path(path)
    trimesh = decoder('trimesh', path, 'meshes')
    with decoding(path):
        cloud = trimesh.load(path, process=False)
        if not isinstance(cloud, trimesh.PointCloud):
            raise FileFormatError(f'{path}: a mesh, expected points; evaluate and view take it')
        columns = dict(zip('xyz', np.asarray(cloud.vertices, np.float64).T, strict=True))
        if len(cloud.colors) == len(cloud.vertices):
            columns |= dict(zip(RGB, np.asarray(cloud.colors, np.uint8).T[:3], strict=True))
        return columns


def read_feather(path: str | Path) -> Columns:
    """Return the columns of a feather file; see decoding."""
    path = Path(path)
    feather = decoder('pyarrow.feather', path, 'formats')
    with decoding(path):
        table = feather.read_table(str(path))
        return {name: table[name].to_numpy() for name in table.column_names}
