# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fusion of scans and depth images into a signed distance field, and errors of the meshes.

A real lidar in a hall at 0.2 m and 0.1 m, if SURFEL_MAPPER_TEST_DATA names its folder; the
simulated street's at 0.2 m; and a depth camera that turns in a room at 4 cm and 1 cm; on one core.
Those of lidars are run with and without carving. Ours carves up to 20 m from the sensor,
peers the whole ray. Peers get a truncation of 3 voxels, in the room of 4 as ours.

In the hall every fourth scan of a recording is fused at its recorded pose, and those half way
between judge: ``median_mm`` is the distance of their points from the mesh, ``recall`` the share
within 1.5 voxels, ``empty`` the share of the area of the mesh without a point within 1.5 voxels.
Elsewhere the truth is an equation.
``x_ours`` is the ratio of processor times, which depend less on other load than clock times. Our
input is points or depths in the frame of the sensor; VDBFusion gets points in the map frame.
Errors of meshes are distances from the equations of street and room; a mesh that is empty or less
than half complete fails. ``mesh_ms`` is the processor time of the whole mesh, made anew, the
least of three.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import itertools
import os
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import TsdfConfig
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.integrator import Integrator
from surfel_mapper.tsdf.mesh import Mesher
from surfel_mapper.tsdf.point_integrator import PointIntegrator
from surfel_mapper.tsdf.range_image import from_depth, RangeImage
from test.bench import room
from test.bench.machine import one_core
from test.bench.mesh_error import mesh_error, point_error
from test.bench.options import Options
from test.bench.peers import PeerSpec
from test.bench.peers.run import PeerError
from test.bench.peers.tsdf import (
    Mesh,
    OPEN3D_LEGACY,
    run_tsdf,
    VDBFUSION,
)
from test.bench.registration import recorded
from test.bench.report import Row, spread
from test.bench.street import Street

FloatArray = npt.NDArray[np.float64]

WARM = 3
"""Number of first scans that are not counted."""

LEAST_F_SCORE = 0.5

HALL, HALL_SCANS = 'hall_os0_long', 118
"""Recording of the hall, and scans that it has; 30 are fused, 29 judge."""

MESHES = 3
"""Number of whole meshes made; the least of their times counts, for peers as well."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """
    Input scans and the true mesh.

    Attributes
    ----------
    name : str
        Name in the table.
    voxel_size_m, truncation_m, carve
        Of the field.
    files : list of Path
        Scans or depth images, .npy.
    poses : (S, 4, 4) float64
        Of each.
    image : callable, optional
        A range image of the content of a file; files of points have none.
    distance : callable, optional
        Distance of points from the true surface, m; the truth is points if there is none.
    truth : (N, 3) float64, m
        Points of it that were in view.
    peers : tuple of PeerSpec
        Packages to compare with.
    settings : dict
        Further settings of the peers.

    """

    name: str
    voxel_size_m: float
    truncation_m: float
    carve: bool
    files: list[Path]
    poses: FloatArray
    image: Callable[[npt.NDArray[Any]], RangeImage] | None
    distance: Callable[[FloatArray], FloatArray] | None
    truth: FloatArray
    peers: tuple[PeerSpec, ...]
    settings: dict[str, Any]


def run(options: Options) -> Iterator[Row]:
    """Yield a row for each package in every case, the first of each ours, and all other rows."""
    scans = min(options.scans, 30)
    cases = hall_cases(options), street_cases(options, scans), room_cases(options, scans)
    for case in itertools.chain(*cases):
        with one_core():
            rows = case_rows(case, options)
        yield from rows


def case_rows(case: Case, options: Options) -> list[Row]:
    """Return the rows of one case."""
    times, mesh, mesh_ms = ours(case)
    reference_ms = float(np.median(times[WARM:, 1]))
    rows = [{**row(case, 'surfel_mapper', times, mesh, reference_ms), 'mesh_ms': mesh_ms}]
    for peer in case.peers if options.peers else ():
        settings = {
            **case.settings,
            'voxel_size_m': case.voxel_size_m,
            'truncation_m': case.truncation_m,
            'carve': case.carve,
            'meshes': MESHES,
        }
        try:
            measured = run_tsdf(peer, options.cache, case.files, case.poses, settings)
            found = row(case, peer.name, *measured[:2], reference_ms)
            rows.append({**found, 'mesh_ms': measured[2]})
        except PeerError as error:
            rows.append({'case': case.name, 'who': f'{peer.name}, not measured: {error}'})
    return rows


def ours(case: Case) -> tuple[FloatArray, Mesh, float]:
    """Return the times of every scan, (S, 2) ms of clock and processor, the mesh, its time."""
    config = TsdfConfig(
        voxel_size_m=case.voxel_size_m,
        truncation_m=0.0 if case.image is None else case.truncation_m,
        carve_m=20.0 if case.carve else 0.0,
        max_range_m=100.0,
        threads=1,
    )
    blocks, times = BlockMap(config), []
    by_points, by_images = PointIntegrator(blocks), Integrator(blocks)
    for path, pose in zip(case.files, case.poses, strict=True):
        data = np.load(path)
        start, busy = perf_counter(), process_time()
        if case.image is None:
            by_points.integrate(data, pose)
        else:
            by_images.integrate(case.image(data), pose)
        times.append(((perf_counter() - start) * 1e3, (process_time() - busy) * 1e3))
    Mesher(blocks).update()  # loads the kernels
    mesh_ms = []
    for _ in range(MESHES):
        busy, mesher = process_time(), Mesher(blocks)
        mesher.update()
        mesh = mesher.mesh()
        mesh_ms.append((process_time() - busy) * 1e3)
    return np.array(times), (mesh.vertices, mesh.triangles), min(mesh_ms)


def row(case: Case, who: str, times: FloatArray, mesh: Mesh, reference_ms: float) -> Row:
    """Return one row; a mesh that is wrong is an error."""
    if case.distance is None:
        error = point_error(*mesh, case.truth, case.voxel_size_m)
    else:
        error = mesh_error(*mesh, case.distance, case.truth, case.voxel_size_m)
    if error.get('f_score', error.get('recall')) < LEAST_F_SCORE:
        raise RuntimeError(f'{case.name}, {who}: the mesh is wrong, {error}')
    figures, cpu_ms = spread(times[WARM:, 0]), float(np.median(times[WARM:, 1]))
    return {
        'case': case.name,
        'who': who,
        **figures,
        'cpu_ms': cpu_ms,
        'x_ours': cpu_ms / reference_ms,
        'scans': len(times) - WARM,
        'triangles': len(mesh[1]),
        **error,
    }


def hall_cases(options: Options) -> list[Case]:
    """Return the cases of the real lidar; none without the folder of its recording."""
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    if not data:
        return []
    directory = options.cache / 'hall'
    directory.mkdir(parents=True, exist_ok=True)
    recording = recorded(Path(data) / 'data' / 'bags' / HALL, directory)
    fused, judges = slice(0, HALL_SCANS, 4), range(2, HALL_SCANS, 4)
    points = [np.load(recording.paths[number]) for number in judges]
    poses = recording.poses[2:HALL_SCANS:4]
    truth = [p @ T[:3, :3].T + T[:3, 3] for p, T in zip(points, poses, strict=True)]
    return [
        Case(
            name=f'hall {size_m:g} m{", carving" if carve else ""}',
            voxel_size_m=size_m,
            truncation_m=3.0 * size_m,
            carve=carve,
            files=list(recording.paths[fused]),
            poses=recording.poses[fused],
            image=None,
            distance=None,
            truth=np.concatenate(truth),
            peers=(VDBFUSION,),
            settings={},
        )
        for carve, size_m in itertools.product((True, False), (0.2, 0.1))
    ]


def street_cases(options: Options, scans: int) -> list[Case]:
    """Return the cases of the lidar, without and with carving."""
    street, numbers = Street(options), range(WARM + scans)
    street.prepare(len(numbers))
    poses = np.array([street.pose(number) for number in numbers])
    seen = [street.points(n)[::16] @ T[:3, :3].T + T[:3, 3] for n, T in enumerate(poses)]
    near = np.concatenate(seen)
    near = near[np.isfinite(near).all(axis=1)]
    world = street.simulation.world
    return [
        Case(
            name=f'street 0.2 m{", carving" if carve else ""}',
            voxel_size_m=0.2,
            truncation_m=0.6,
            carve=carve,
            files=[street.path(number) for number in numbers],
            poses=poses,
            image=None,
            distance=lambda points: world.surface_at(points)[1],
            truth=near,
            peers=(VDBFUSION,),
            settings={},
        )
        for carve in (False, True)
    ]


def room_cases(options: Options, scans: int) -> list[Case]:
    """Return the cases of the depth camera, coarse and fine."""
    camera, directory = room.CAMERA, options.cache / 'room'
    directory.mkdir(parents=True, exist_ok=True)
    poses = np.array([room.pose(number) for number in range(WARM + scans)])
    files, truth = [], []
    for number, pose in enumerate(poses):
        depth = room.depth(pose)
        files.append(directory / f'{number:05d}.npy')
        np.save(files[-1], depth)
        rays = camera.directions * (depth * camera.ray_length)[..., None]
        truth.append(rays[::8, ::8].reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3])
    intrinsic = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    return [
        Case(
            name=f'room {size_m:g} m',
            voxel_size_m=size_m,
            truncation_m=4.0 * size_m,
            carve=False,
            files=files,
            poses=poses,
            image=lambda depth: from_depth(camera, depth),
            distance=room.distance,
            truth=np.concatenate(truth),
            peers=(OPEN3D_LEGACY,),
            settings={
                'intrinsic': intrinsic,
                'columns': camera.columns,
                'rows': camera.rows,
                'max_range_m': camera.max_range_m,
            },
        )
        for size_m in (0.04, 0.01)
    ]
