# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The files that a replay writes, each whole or not at all; summary.json last.

So if summary.json is new, all other files are too.
"""

from __future__ import annotations

from collections.abc import Sequence
import csv
from dataclasses import asdict
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.counters import STAGES
from surfel_mapper.errors import ConfigError, counted, FileFormatError, one_line
from surfel_mapper.files import parquet, pcd, ply
from surfel_mapper.files.atomic import (
    make_directory,
    nearest_directory,
    replace_file,
    write_json,
)
from surfel_mapper.files.map_state import save_map
from surfel_mapper.files.parquet_tiles import check_dataset, write_tiles
from surfel_mapper.files.trajectory import TRAJECTORY, write_tum
from surfel_mapper.layers import formats as layer_formats
from surfel_mapper.layers import load as load_layer
from surfel_mapper.layers.drawings import Drawing
from surfel_mapper.offline.options import BAG, known_formats, MAP_FORMATS, TILES
from surfel_mapper.offline.summary import in_order, rounded
from surfel_mapper.pipeline import Mapper, ScanOutcome, Update
from surfel_mapper.pipeline.map_part import ApartMap
from surfel_mapper.pipeline.saved_state import save_mapper
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.detail import drawn_surfels
from surfel_mapper.viz.drawings import draw_points, page_meshes, section_html
from surfel_mapper.viz.history import History
from surfel_mapper.viz.picture import draw_map
from surfel_mapper.viz.report import write_report
from surfel_mapper.viz.turning_view import most_shown

SCANS = 'scans.csv'
"""File of the outcomes of all scans."""

COLUMNS = (
    'stamp_ns',
    'frame_id',
    'topic',
    'outcome',
    'cause',
    'reason',
    'pose_source',
    'num_points',
)
"""Columns of scans.csv before the times; the attributes of ScanOutcome."""


def file_names(formats: Sequence[str]) -> list[str]:
    """Return the names of the files of a replay in the output directory, for some formats."""
    files = known_formats()
    always = (TRAJECTORY, SCANS, 'map.png', 'report.html', 'summary.json')
    return [*(files[name] for name in formats), *always]


def check_layer_formats(names: Sequence[str], config: Config) -> None:
    """
    Raise unless the layers that write some formats are switched on, and can write them.

    Raises
    ------
    ConfigError
        If a layer is switched off.
    DependencyError
        If a package that it needs for the format is not installed.

    """
    by_format = layer_formats()
    for name in (name for name in names if name in by_format):
        layer = by_format[name]
        if layer.switch and not config.to_mapping()[layer.switch]:
            raise ConfigError(
                f'formats: {name} is written by the layer {layer.name}, expected {layer.switch}: '
                'true in the configuration'
            )
        load_layer(layer).check_formats([name])


def output_directory(recording: Path, wanted: Path | None) -> Path:
    """
    Return the directory to write to, after checking that it can be made.

    Parameters
    ----------
    recording : Path
        Gives the default: its name followed by _surfels, in the working directory.
    wanted : Path, optional
        The directory asked for.

    Raises
    ------
    FileFormatError
        If it cannot be a directory, or must not be written to.

    """
    full = recording.resolve()
    directory = wanted or Path(f'{full.stem if recording.is_file() else full.name}_surfels')
    nearest = nearest_directory(directory)
    if not os.access(nearest, os.W_OK):
        raise FileFormatError(f'{directory}: no permission to write in {nearest}')
    return directory


def check_writable(path: Path) -> None:
    """Raise FileFormatError unless a file can be created or replaced; nothing is written."""
    folder = path.absolute().parent
    if not folder.is_dir():
        raise FileFormatError(f'{path}: cannot be written: no directory {folder}; create it first')
    if path.is_dir():
        raise FileFormatError(f'{path}: cannot be written: it is a directory, expected a file')
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise FileFormatError(f'{path}: cannot be written: Permission denied')


def check_formats(formats: Sequence[str], output: Path) -> None:
    """
    Raise if a format cannot be written: its package is missing, or its path is of another kind.

    Raises
    ------
    DependencyError
        If pyarrow is needed and not installed.
    FileFormatError
        If a file of the output directory cannot be written.

    """
    if 'parquet' in formats or TILES in formats:
        parquet.import_pyarrow()
    for name in file_names(formats):
        if (output / name).exists() and name not in (MAP_FORMATS[BAG], MAP_FORMATS[TILES]):
            check_writable(output / name)
    if TILES in formats:
        check_dataset(output / MAP_FORMATS[TILES])


class ScanTrajectory:
    """
    Stamp and pose of every mapped scan, since the map was cleared if time was set back.

    Attributes
    ----------
    stamps_ns : list of int
    poses : list of (4, 4) float64
        T_map_sensor of each scan.

    """

    def __init__(self, mapper: Mapper) -> None:
        self._map = mapper.map
        self.stamps_ns: list[int] = []
        self.poses: list[npt.NDArray[np.float64]] = []
        self._cleared_at = self._map.cleared_at

    def add(self, update: Update) -> None:
        """Append the pose of a mapped scan."""
        if self._map.cleared_at != self._cleared_at:
            self._cleared_at = self._map.cleared_at
            self.stamps_ns.clear()
            self.poses.clear()
        self.stamps_ns.append(update.stamp_ns)
        self.poses.append(update.T_map_sensor)

    def follow_alignment(self, mapper: Mapper) -> None:
        """Replace the poses of scans that loops or the alignment of the window have moved."""
        if mapper.loops is not None and mapper.loops.stamps_ns == self.stamps_ns:
            self.poses = list(mapper.loops.T_map_sensor)
        for back, scan in enumerate(reversed(list(mapper.window)), start=1):
            if back > len(self.stamps_ns) or self.stamps_ns[-back] != scan.stamp_ns:
                break
            self.poses[-back] = scan.T_map_sensor

    def write(self, path: Path) -> None:
        """Write the poses in the fixed frame as TUM text."""
        write_tum(path, *self.by_time)

    @property
    def by_time(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """Ascending stamps, (S,), and T_fixed_sensor, (S, 4, 4); the first scan of each stamp."""
        stamps_ns, rows = np.unique(np.array(self.stamps_ns, np.int64), return_index=True)
        poses = self.matrices[rows]
        poses[:, :3, 3] += self._map.origin_m
        return stamps_ns, poses

    @property
    def matrices(self) -> npt.NDArray[np.float64]:
        """The poses in the map as one array, (S, 4, 4)."""
        return np.array(self.poses).reshape(-1, 4, 4)

    @property
    def positions(self) -> npt.NDArray[np.float64]:
        """Positions of the sensor in the map frame, (S, 3) m."""
        return self.matrices[:, :3, 3]


def write_maps(
    output: Path,
    formats: Sequence[str],
    mapper: Mapper,
    trajectory: ScanTrajectory,
    *,
    window: bool = False,
) -> None:
    """
    Write the map in some formats, and the trajectory; npz with the window if that is kept.

    Parts that registration could not place on the map become apart_1.npz and apart_1.tum, and so
    on; those of an earlier replay are removed.
    """
    make_directory(output)
    for name, file in MAP_FORMATS.items():
        if name in formats:
            write_map(output / file, name, mapper, window=window)
    trajectory.write(output / TRAJECTORY)
    for old in (*output.glob('apart_*.npz'), *output.glob('apart_*.tum')):
        old.unlink()
    for number, apart in enumerate(mapper.registered.apart if mapper.registered else (), start=1):
        write_apart(output / f'apart_{number}', apart)


def write_apart(path: Path, apart: ApartMap) -> None:
    """Write a part of the map that stayed apart, and the poses on it, to path.npz and .tum."""
    save_map(path.with_suffix('.npz'), apart.map)
    write_tum(path.with_suffix('.tum'), list(apart.stamps_ns), np.array(apart.poses))


def write_layers(
    output: Path, formats: Sequence[str], mapper: Mapper
) -> tuple[dict[str, Mesh], list[str]]:
    """Write the files and pictures of layers; return their meshes and sections for the report."""
    drawings: list[Drawing] = []
    sections: list[str] = []
    for layer in mapper.layers.values():
        layer.write(output, formats)
        drawings += layer.drawings()
        section = layer.section()
        if section is not None:
            picture_path = None
            if section.picture is not None:
                picture_path = output / section.picture.file_name
                draw_points(picture_path, section.picture)
            sections.append(section_html(section, picture_path))
    return page_meshes(drawings), sections


def write_files(
    output: Path,
    formats: Sequence[str],
    mapper: Mapper,
    trajectory: ScanTrajectory,
    summary: dict[str, Any],
    history: History | None = None,
) -> list[Path]:
    """
    Write scans, layers, picture, report and summary, after the map.

    Returns
    -------
    list of Path
        The files of the formats, then trajectory, scans, picture, report and summary.

    """
    meshes, sections = write_layers(output, formats, mapper) if mapper.layers else ({}, [])
    picture, page, figures = (output / n for n in ('map.png', 'report.html', 'summary.json'))
    surfels = mapper.map.surfels(mapper.config.map.min_points)
    title = (
        f'{Path(summary["bag"]).resolve().name}: {counted(summary["scans"]["mapped"], "scan")}, '
        f'{rounded(summary["points"])} points, '
        f'{counted(len(surfels), "surfel")} in voxels of {mapper.map.voxel_size_m:g} m'
    )
    origin_m, drawn = mapper.map.origin_m, mapper.map.adaptive(mapper.config.map.min_points)
    draw_map(drawn, picture, title, trajectory=trajectory.positions, origin_m=origin_m)
    target = trajectory.positions[-1] if trajectory.stamps_ns else (0.0, 0.0, 0.0)
    min_points, most = mapper.config.map.min_points, most_shown(meshes)
    in_view = drawn_surfels(drawn, mapper.map, min_points, target, most)
    write_report(page, title, summary, surfels, history, meshes, sections, in_view)
    write_outcomes(output / SCANS, mapper.outcomes or [])
    write_json(figures, summary)
    return [output / name for name in file_names(formats)]


def write_outcomes(path: Path, outcomes: Sequence[ScanOutcome]) -> None:
    """Write the outcomes of scans as a table, one row a scan; the times are ms by stage."""
    times_ms = {stage: 0.0 for outcome in outcomes for stage in outcome.milliseconds}
    stages = [stage for stage, _ in in_order(times_ms, STAGES)]
    text = io.StringIO(newline='')
    table = csv.writer(text, lineterminator='\n')
    table.writerow([*COLUMNS, *(f'{stage}_ms' for stage in stages)])
    for outcome in outcomes:
        row = asdict(outcome)
        times = [row['milliseconds'].get(stage) for stage in stages]
        values = [row[name] for name in COLUMNS]
        table.writerow(
            [
                *(one_line(value) if isinstance(value, str) else value for value in values),
                *('' if time_ms is None else f'{time_ms:.3f}' for time_ms in times),
            ]
        )
    with replace_file(path) as file:
        file.write(text.getvalue().encode())


def write_map(path: Path, name: str, mapper: Mapper, *, window: bool = False) -> None:
    """Write the map in one format."""
    derive = mapper.map.adaptive if mapper.config.publish.adaptive else mapper.map.surfels
    min_points, origin_m = mapper.config.map.min_points, mapper.map.origin_m
    if name == 'ply':
        ply.write_surfels(path, derive(min_points, covariance=True), origin_m)
    elif name == 'pcd':
        pcd.write_surfels(path, derive(min_points, covariance=True), origin_m)
    elif name == 'parquet':
        parquet.write_map(path, mapper.map)
    elif name == TILES:
        write_tiles(path, mapper.map)
    elif name == 'npz':
        save_mapper(path, mapper, with_window=window)
