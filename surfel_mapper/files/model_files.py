# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Models as files: packed (SMM), which ``models.read`` reads, and for other programs.

JSON is complete, Parquet has a row per primitive. OBJ and GLB have triangles, an object for each
plane and surface, without Gaussians.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.files.atomic import replace_file
from surfel_mapper.files.parquet import import_pyarrow
from surfel_mapper.files.triangles import GLTF, import_trimesh, write_scene, Y_UP
from surfel_mapper.models.multi_model import Gaussians, MultiModel, Plane, Surface
from surfel_mapper.models.outlines import outline
from surfel_mapper.models.shapes import shape_of

FORMAT, VERSION = 'surfel_mapper models', 1

PACKED = 'models.smm'
"""File name of packed models."""

TRIANGLES = ('obj', 'glb')


def write_models(
    directory: Path,
    model: MultiModel,
    formats: Sequence[str],
    versions: Mapping[int, int] | None = None,
) -> list[Path]:
    """
    Write models as ``models`` for other programs; return the files.

    Without planes and surfaces there is no file of triangles.

    Parameters
    ----------
    directory : Path
        Directory of the files.
    model : MultiModel
        The models.
    formats : sequence of str
        Any of json, parquet, obj, glb.
    versions : mapping of int to int, optional
        Versions of the primitives, by id; written to JSON and Parquet.

    Raises
    ------
    FileFormatError
        If a file cannot be written.
    DependencyError
        If pyarrow or trimesh is needed and not installed.

    """
    has_triangles = len(model.patches) > 0
    names = [name for name in formats if has_triangles or name not in TRIANGLES]
    paths = [directory / f'models.{name}' for name in names]
    for name, path in zip(names, paths, strict=True):
        if name == 'json':
            write_json(path, model, versions)
        elif name == 'parquet':
            write_parquet(path, model, versions)
        else:
            write_meshes(path, model)
    return paths


def write_packed(
    path: str | Path, model: MultiModel, versions: Mapping[int, int] | None = None
) -> Path:
    """
    Write models packed, for models.read; return the file.

    Raises
    ------
    FileFormatError
        If the file cannot be written.
    ModelError
        If a number is not finite.

    """
    with replace_file(path) as file:
        file.write(model.to_bytes(versions))
    return Path(path)


def write_json(
    path: str | Path, model: MultiModel, versions: Mapping[int, int] | None = None
) -> None:
    """
    Write models as JSON, lengths in m.

    A plane or surface: id, num_points, mean, R_patch_map (rows x, y, normal), rms_m, normal and
    offset_m of its plane, and outline, a list of rings. A surface also: pitch_m, origin, degrees
    and control of its spline. A Gaussian: id, num_points, mean, covariance. Each also has its
    version, if versions are given.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    primitives = {
        'planes': [patch_content(plane) for plane in model.planes],
        'surfaces': [surface_content(surface) for surface in model.surfaces],
        'gaussians': gaussian_content(model.gaussians),
    }
    if versions is not None:
        for primitive in itertools.chain(*primitives.values()):
            primitive['version'] = versions[primitive['id']]
    content = {
        'format': FORMAT,
        'version': VERSION,
        'voxel_size_m': model.voxel_size_m,
        **primitives,
    }
    with replace_file(path) as file:
        file.write(json.dumps(content, allow_nan=False).encode())


def patch_content(patch: Plane) -> dict[str, Any]:
    """Return a plane or surface as JSON values."""
    return {
        'id': patch.id,
        'num_points': patch.num_points,
        'mean': patch.mean.tolist(),
        'R_patch_map': patch.R_patch_map.tolist(),
        'covariance': patch.covariance.tolist(),
        'rms_m': patch.rms_m,
        'normal': patch.normal.tolist(),
        'offset_m': patch.offset_m,
        'outline': [ring.tolist() for ring in outline(patch)],
    }


def surface_content(surface: Surface) -> dict[str, Any]:
    """Return a surface as JSON values."""
    spline = surface.spline
    return {
        **patch_content(surface),
        'pitch_m': spline.pitch_m,
        'origin': spline.origin.tolist(),
        'degrees': list(spline.degrees),
        'control': spline.control.tolist(),
        'greville': [axis.tolist() for axis in spline.greville()],
    }


def gaussian_content(gaussians: Gaussians) -> list[dict[str, Any]]:
    """Return Gaussians as JSON values."""
    return [
        {
            'id': int(gaussians.id[k]),
            'num_points': int(gaussians.num_points[k]),
            'mean': gaussians.mean[k].tolist(),
            'covariance': gaussians.covariance[k].tolist(),
        }
        for k in range(len(gaussians))
    ]


def columns(model: MultiModel) -> dict[str, npt.NDArray[Any]]:
    """
    Return columns with one row per primitive: planes, surfaces, Gaussians.

    id, kind, num_points, mean_x to mean_z, cov_xx to cov_zz, and for planes and surfaces the
    normal, offset_m, rms_m and area_m2; nan for Gaussians.
    """
    patches, gaussians = model.patches, model.gaussians
    kinds = ['plane'] * len(model.planes) + ['surface'] * len(model.surfaces)
    means = np.array([patch.mean for patch in patches]).reshape(-1, 3)
    covariances = np.array([patch.covariance for patch in patches]).reshape(-1, 3, 3)
    mean = np.concatenate([means, gaussians.mean])
    covariance = np.concatenate([covariances, gaussians.covariance])
    flat = [[*p.normal, p.offset_m, p.rms_m, p.grid.area_m2(PARTS_OF_AREA)] for p in patches]
    extra = np.full((len(mean), 6), np.nan)
    extra[: len(patches)] = np.array(flat).reshape(-1, 6)
    names = ('normal_x', 'normal_y', 'normal_z', 'offset_m', 'rms_m', 'area_m2')
    numbers = [patch.num_points for patch in patches]
    return {
        'id': np.concatenate([np.array([p.id for p in patches], np.int64), gaussians.id]),
        'kind': np.array(kinds + ['gaussian'] * len(gaussians), dtype=object),
        'num_points': np.concatenate([np.array(numbers, np.int64), gaussians.num_points]),
        **{f'mean_{axis}': mean[:, k] for k, axis in enumerate('xyz')},
        **{
            f'cov_{"xyz"[i]}{"xyz"[j]}': covariance[:, i, j] for i in range(3) for j in range(i, 3)
        },
        **{name: extra[:, k] for k, name in enumerate(names)},
    }


PARTS_OF_AREA = 8
"""Resolution of areas: squares per edge of a cell."""


def write_parquet(
    path: str | Path, model: MultiModel, versions: Mapping[int, int] | None = None
) -> None:
    """
    Write one row per primitive as Parquet (see columns), with ``version`` if versions are given.

    Raises
    ------
    FileFormatError
        If the file cannot be written.
    DependencyError
        If pyarrow is not installed.

    """
    arrow, parquet = import_pyarrow()
    table = columns(model)
    if versions is not None:
        table['version'] = np.array([versions[number] for number in table['id']], np.int64)
    with replace_file(path) as file:
        parquet.write_table(arrow.table(table), file, compression='zstd')


def write_meshes(path: Path, model: MultiModel) -> None:
    """
    Write planes and surfaces as triangles, OBJ or GLB: an object each, named by kind and id.

    Raises
    ------
    FileFormatError
        If there are none, or the file cannot be written.
    DependencyError
        If trimesh is not installed.

    """
    trimesh = import_trimesh()
    scene = trimesh.Scene(base_frame='map')
    turn = Y_UP if path.suffix in GLTF else None
    for patch in model.patches:
        shape = shape_of(patch)
        name = f'{"surface" if shape.is_curved else "plane"}_{patch.id}'
        mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
        scene.add_geometry(mesh, node_name=name, geom_name=name, transform=turn)
    write_scene(path, scene)
