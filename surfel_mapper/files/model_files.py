# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Models as files: complete as JSON, a row per primitive as Parquet, geometry as OBJ, DXF and STEP.

OBJ is for viewers, DXF for CAD; each plane and surface is an object of its own there, without
Gaussians. DXF is that of AutoCAD 2000 and later, in metres, with outlines as closed polylines and
faces as meshes. ezdxf writes it, because readers expect tables and headers beside the entities
that are easily wrong when written by hand.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import io
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import DependencyError
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.files.model_step import write_step
from surfel_mapper.files.parquet import import_pyarrow
from surfel_mapper.models.multi_model import Gaussians, MultiModel, Plane, Surface
from surfel_mapper.models.outlines import outline
from surfel_mapper.models.shapes import shape_of

FORMAT, VERSION = 'surfel_mapper models', 1


def write_models(
    directory: Path,
    model: MultiModel,
    formats: Sequence[str],
    versions: Mapping[int, int] | None = None,
) -> list[Path]:
    """
    Write models as ``models`` in some formats: json, obj, parquet, dxf, step; return the files.

    Parameters
    ----------
    directory : Path
        Directory of the files.
    model : MultiModel
        The models.
    formats : sequence of str
        Any of json, obj, parquet, dxf, step.
    versions : mapping of int to int, optional
        Versions of the primitives, by id; written to JSON and Parquet.

    Raises
    ------
    FileFormatError
        If a file cannot be written.
    DependencyError
        If pyarrow, ezdxf or cadquery-ocp is needed and not installed.

    """
    paths = [directory / f'models.{name}' for name in formats]
    for name, path in zip(formats, paths, strict=True):
        if name == 'json':
            write_json(path, model, versions)
        elif name == 'parquet':
            write_parquet(path, model, versions)
        elif name == 'obj':
            write_obj(path, model)
        elif name == 'step':
            write_step(path, model)
        else:
            write_dxf(path, model)
    return paths


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


def write_obj(path: str | Path, model: MultiModel) -> None:
    """
    Write planes and surfaces as triangles, one OBJ object each, named by kind and id.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    begin = 1  # OBJ counts vertices from 1, through all objects
    with replace_file(path) as file:
        file.write(b'# surfel_mapper models, m\n')
        for patch in model.patches:
            shape = shape_of(patch)
            kind = 'surface' if shape.is_curved else 'plane'
            file.write(f'o {kind}_{patch.id}\n'.encode())
            np.savetxt(file, shape.vertices, 'v %.6f %.6f %.6f')
            np.savetxt(file, shape.faces + begin, 'f %d %d %d')
            begin += len(shape.vertices)


LAYERS = {
    'plane_outlines': 1,
    'planes': 8,
    'surface_outlines': 5,
    'surfaces': 8,
}
"""Layers and their AutoCAD colours: red, grey, blue, grey."""


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
