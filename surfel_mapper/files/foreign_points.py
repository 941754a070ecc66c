# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Points in formats that libraries read: E57, VTK, OBJ, and the feather files of Argoverse 2.

E57 has several scans, each with its pose: ``read_e57`` returns all in the frame of the file.
"""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import DependencyError, FileFormatError
from surfel_mapper.files.point_columns import Columns, NORMALS, RGB
from surfel_mapper.libraries import library

E57_COLUMNS = {
    **{f'cartesian{axis.upper()}': axis for axis in 'xyz'},
    'intensity': 'intensity',
    **{f'color{name.capitalize()}': name for name in RGB},
}

TAIL_BYTES = 1 << 16
"""End of an OBJ file in which faces are looked for, bytes."""


def decoder(name: str, path: str | Path, extra: str) -> Any:
    """Return the module that reads a file, of an extra of this package; see library."""
    return library(name, f'reads {Path(path).suffix}', f"'surfel_mapper[{extra}]'")


def decoded(path: Path, read: Callable[[], Columns]) -> Columns:
    """Return columns of a decoder; raise FileFormatError for its errors."""
    try:
        with open_regular(path):
            pass
        return read()
    except (DependencyError, FileFormatError, MemoryError):
        raise
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error
    except Exception as error:  # those of many decoders
        raise FileFormatError(
            f'{path}: no {path.suffix} that can be read: {type(error).__name__}: {error}; '
            'expected one, or points as .ply, .pcd, .las, .xyz, .npy'
        ) from error


def read_e57(path: str | Path, number: int | None = None) -> Columns:
    """Return the points of all scans of an E57 file, or of one, in its frame; see decoded."""
    path = Path(path)
    pye57 = decoder('pye57', path, 'clouds')

    def read() -> Columns:
        with pye57.E57(str(path)) as file:
            numbers = range(file.scan_count) if number is None else [number]
            scans = [e57_scan(file, at) for at in numbers]
        if not scans:
            raise FileFormatError(f'{path}: no scans in it')
        names = [name for name in scans[0] if all(name in scan for scan in scans)]
        return {name: np.concatenate([scan[name] for scan in scans]) for name in names}

    return decoded(path, read)


def e57_scan(file: Any, number: int) -> Columns:
    """Return the columns of a scan in an open E57, in the frame of the file."""
    columns = file.read_scan(number, intensity=True, colors=True, ignore_missing_fields=True)
    return {E57_COLUMNS[name]: columns[name] for name in E57_COLUMNS if name in columns}


def e57_poses(path: Path) -> npt.NDArray[np.float64]:
    """Return the poses of the scanner, T_file_scanner (S, 4, 4); see decoded."""
    pye57 = decoder('pye57', path, 'clouds')
    poses: list[npt.NDArray[np.float64]] = []

    def read() -> Columns:
        with pye57.E57(str(path)) as file:
            for number in range(file.scan_count):
                header, pose = file.get_header(number), np.eye(4)
                if header.has_pose():
                    pose[:3, :3], pose[:3, 3] = header.rotation_matrix, header.translation
                poses.append(pose)
        return {}

    decoded(path, read)
    return np.array(poses).reshape(-1, 4, 4)


def read_vtk(path: str | Path) -> Columns:
    """Return the points of a VTK file, legacy or XML, and their scalars; see decoded."""
    path = Path(path)
    is_legacy = path.suffix.lower() == '.vtk'
    module = decoder(f'vtkmodules.vtkIO{"Legacy" if is_legacy else "XML"}', path, 'clouds')
    numpy_of = decoder('vtkmodules.util.numpy_support', path, 'clouds').vtk_to_numpy
    decoder('vtkmodules.vtkCommonCore', path, 'clouds').vtkObject.GlobalWarningDisplayOff()
    decoder('vtkmodules.vtkCommonDataModel', path, 'clouds')

    def read() -> Columns:
        names = {'.vtk': 'vtkGenericDataObjectReader', '.vtp': 'vtkXMLPolyDataReader'}
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
        for at in range(attributes.GetNumberOfArrays()):
            array = attributes.GetArray(at)
            if array is not None and array.GetNumberOfTuples() == len(table):
                columns |= vtk_columns(array.GetName() or f'array_{at}', np.array(numpy_of(array)))
        return columns

    return decoded(path, read)


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
    """Return the vertices of an OBJ file without faces, and their colours; see decoded."""
    path = Path(path)
    trimesh = decoder('trimesh', path, 'meshes')

    def read() -> Columns:
        cloud = trimesh.load(path, process=False)
        if not isinstance(cloud, trimesh.PointCloud):
            raise FileFormatError(f'{path}: a mesh, expected points; evaluate and view take it')
        columns = dict(zip('xyz', np.asarray(cloud.vertices, np.float64).T, strict=True))
        if len(cloud.colors) == len(cloud.vertices):
            columns |= dict(zip(RGB, np.asarray(cloud.colors, np.uint8).T[:3], strict=True))
        return columns

    return decoded(path, read)


def read_feather(path: str | Path) -> Columns:
    """Return the columns of a feather file, float16 as float32; see decoded."""
    path = Path(path)
    feather = decoder('pyarrow.feather', path, 'formats')

    def read() -> Columns:
        table = feather.read_table(str(path))
        columns = {name: table[name].to_numpy() for name in table.column_names}
        is_half = {name: values.dtype == np.float16 for name, values in columns.items()}
        return {n: v.astype(np.float32) if is_half[n] else v for n, v in columns.items()}

    return decoded(path, read)
