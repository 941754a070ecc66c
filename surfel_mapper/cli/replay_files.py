# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The files that a replay writes, each whole or not at all; summary.json last."""

from __future__ import annotations

from collections.abc import Sequence
import logging
import os
from pathlib import Path
from typing import Any, TYPE_CHECKING

from surfel_mapper.cli.replay_report import rounded

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from surfel_mapper.models.live import LiveModels
    from surfel_mapper.pipeline import Mapper, Update
    from surfel_mapper.viz.history import History

BAG = 'bag'
"""Written while mapping, and so not here: a bag of normals in the directory ``normals``."""

DXF = 'dxf'
"""Of planes and surfaces, where ``layers.models.enabled``."""

FORMATS = {
    'ply': 'map.ply',
    'pcd': 'map.pcd',
    'parquet': 'map.parquet',
    'npz': 'map.npz',
    DXF: 'models.dxf',
    BAG: 'normals',
}
"""What the map is written as, and where: npz and parquet are exact, to be loaded again."""

MODELS_PICTURE = 'models.png'

SAME_TIME_NS = 10_000_000
"""Poses of a scan and of the truth at most so far apart are of one time."""

_log = logging.getLogger(__name__)


def output_directory(bag: Path, wanted: Path | None) -> Path:
    """Return where to write; refuse what cannot be a directory before the work begins."""
    from surfel_mapper.errors import FileFormatError

    name = bag.resolve().stem if bag.is_file() else bag.resolve().name
    directory = wanted or Path(f'{name}_surfels')
    absolute = directory.absolute()
    nearest = next(path for path in (absolute, *absolute.parents) if path.exists())
    if not nearest.is_dir():
        raise FileFormatError(f'{directory}: {nearest} is a file, expected a directory')
    if not os.access(nearest, os.W_OK):
        raise FileFormatError(f'{directory}: no permission to write in {nearest}')
    return directory


class Mapped:
    """Stamp and pose of every scan that was mapped."""

    def __init__(self) -> None:
        """Begin without any."""
        self.stamps_ns: list[int] = []
        self.poses: list[npt.NDArray[np.float64]] = []

    def add(self, update: Update) -> None:
        """Take note of a scan."""
        self.stamps_ns.append(update.stamp_ns)
        self.poses.append(update.T_map_sensor)

    def write(self, path: Path) -> None:
        """Write the poses as TUM text."""
        import numpy as np

        from surfel_mapper.files.trajectory import write_tum

        write_tum(path, self.stamps_ns, np.array(self.poses).reshape(-1, 4, 4))

    @property
    def positions(self) -> npt.NDArray[np.float64]:
        """Where the sensor was, (S, 3) m."""
        import numpy as np

        return np.array([pose[:3, 3] for pose in self.poses]).reshape(-1, 3)


def write_files(
    output: Path,
    formats: Sequence[str],
    mapper: Mapper,
    mapped: Mapped,
    summary: dict[str, Any],
    history: History,
) -> list[Path]:
    """Write the map in some formats, picture, report and summary; return what is there."""
    from surfel_mapper.files.atomic import write_json
    from surfel_mapper.files.ply import write_mesh
    from surfel_mapper.models.shapes import Shapes
    from surfel_mapper.viz.models import models_section, page_mesh
    from surfel_mapper.viz.picture import draw_map
    from surfel_mapper.viz.report import write_report

    output.mkdir(parents=True, exist_ok=True)
    for name in formats:
        write_map(output / FORMATS[name], name, mapper)
    layers, sections = {}, []
    if mapper.tsdf is not None:
        mapper.tsdf.finish(mapper.window)
        layers['mesh'] = mapper.tsdf.mesh()
        write_mesh(output / 'mesh.ply', layers['mesh'])
    if mapper.models is not None:
        write_live_models(output, formats, mapper.models)
        model = mapper.models.model
        shapes = Shapes().of(model, mapper.models.versions)
        layers['models'] = page_mesh(shapes, model.gaussians)
        sections.append(models_section(model, shapes, output / MODELS_PICTURE))
    picture, page, figures = (output / n for n in ('map.png', 'report.html', 'summary.json'))
    surfels = mapper.map.surfels(mapper.config.map.min_points)
    title = (
        f'{Path(summary["bag"]).resolve().name}: {summary["scans"]["mapped"]} scans, '
        f'{rounded(summary["points"])} points, '
        f'{len(surfels)} surfels in voxels of {mapper.map.voxel_size_m:g} m'
    )
    draw_map(surfels, picture, title, trajectory=mapped.positions)
    write_report(page, title, summary, surfels, history, picture, layers, sections)
    write_json(figures, summary)
    return [*(output / FORMATS[name] for name in formats), picture, page, figures]


def write_map(path: Path, name: str, mapper: Mapper) -> None:
    """Write the map in one format."""
    from surfel_mapper.files import map_state, parquet, pcd, ply

    surfels = mapper.map.surfels(mapper.config.map.min_points)
    if name == 'ply':
        ply.write_surfels(path, surfels)
    elif name == 'pcd':
        pcd.write_surfels(path, surfels)
    elif name == 'parquet':
        parquet.write_map(path, mapper.map)
    elif name == 'npz':
        map_state.save_map(path, mapper.map, mapper.window)


def write_live_models(output: Path, formats: Sequence[str], models: LiveModels) -> None:
    """Write models as JSON and OBJ, in what other formats are asked for, and their picture."""
    from surfel_mapper.files.model_files import write_models
    from surfel_mapper.models.surfel_points import above, surfel_points
    from surfel_mapper.viz.models import draw_models

    wanted = ['json', 'obj', *(name for name in ('parquet', DXF) if name in formats)]
    write_models(output, models.model, wanted, models.versions)
    surfels = models.surfels
    points = surfel_points(surfels, models.model.voxel_size_m)
    title = f'{len(surfels)} voxels'
    draw_models(output / MODELS_PICTURE, points, models.model, above(surfels), title)


def check_truth(truth: Path) -> None:
    """Refuse a file or bag without true poses, before hours of work."""
    import numpy as np

    from surfel_mapper.cli.evaluate import true_poses

    true_poses(truth, np.zeros(1, np.int64))


def pose_errors(truth: Path | None, mapped: Mapped) -> dict[str, Any]:
    """Return how far the poses are from the true ones, for the summary; nothing without truth."""
    import numpy as np

    from surfel_mapper.alignment.trajectory_errors import compare
    from surfel_mapper.cli.evaluate import true_poses

    if truth is None:
        return {}
    stamps_ns = np.array(mapped.stamps_ns, np.int64)
    try:
        errors = compare(
            stamps_ns,
            np.array(mapped.poses).reshape(-1, 4, 4),
            *true_poses(truth, stamps_ns),
            max_difference_ns=SAME_TIME_NS,
        )
    except ValueError as error:
        _log.warning('--truth %s: %s', truth, error)
        return {}
    return {'pose_errors': errors}
