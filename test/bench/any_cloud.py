# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Share of the points of a cloud that the mesh of the distance field goes through, for any cloud.

The layer gets the scans as a node does, with voxels of 0.2 m and a truncation of 0.6 m, and finds
the sensor itself; VDBFusion gets the same points in the map frame, without carving. A point counts
if the mesh is within 1.5 voxels of it. Rows of real scans need SURFEL_MAPPER_TEST_DATA.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from surfel_mapper.simulation import Lidar, Simulation, World
from surfel_mapper.simulation.primitives import Primitive
from test.bench.mesh_error import distances_to_mesh
from test.bench.options import Options
from test.bench.peers.run import PeerError
from test.bench.peers.tsdf import run_tsdf, VDBFUSION
from test.bench.report import Row

VOXEL_M, TRUNCATION_M, NEAR_VOXELS = 0.2, 0.6, 1.5
MIN_RANGE_M, MAX_RANGE_M = 0.5, 50.0

MOST_CHECKED = 50_000
"""Points of a cloud that are compared with the mesh, evenly picked."""

REAL = {
    'VLP-16 without ring': 'velodyne_vlp16_lab.pcd',
    'two VLP-32C merged': 'argoverse2_2xvlp32_sweep.ply',
    'Hesai AT128': 'hesai_at128_lab.pcd',
    'Livox, accumulated': 'livox_mlcc_scene2_l1_10.pcd',
    'HDL-32E': 'nuscenes_hdl32_1532402927647951.pcd.bin',
    'OS2-128': 'ouster_os2_128.ply',
    'VLS-128 without ring': 'velodyne_vls128_street.pcd',
}

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Case:
    """
    Scans of one sensor.

    Attributes
    ----------
    name : str
        Name in the table.
    scans : list of Scan
        In the order of their stamps.
    poses : list of (4, 4) float64
        Of each.
    checked : (N, 3) float64, m
        Points in the map frame that the mesh should go through.
    settings : dict
        Settings of the layer beside the sizes.

    """

    name: str
    scans: list[Scan]
    poses: list[FloatArray]
    checked: FloatArray
    settings: dict[str, Any]


def cloud_rows(options: Options) -> Iterator[Row]:
    """Yield a row for each cloud and setting."""
    for case in cases(options):
        yield from (share_row(case, carve=carve) for carve in (False, True))
        yield from peer_rows(case, options) if options.peers else ()


def share_row(case: Case, *, carve: bool) -> Row:
    """Return the share of the points of a case within reach of our mesh."""
    settings = {f'layers.tsdf.{name}': value for name, value in case.settings.items()}
    sizes = {
        'layers.tsdf.voxel_size_m': VOXEL_M,
        'layers.tsdf.truncation_m': TRUNCATION_M,
        'layers.tsdf.min_range_m': MIN_RANGE_M,
        'layers.tsdf.max_range_m': MAX_RANGE_M,
    }
    config = Config.from_mapping(
        {'layers.tsdf.enabled': True, 'layers.tsdf.carve': carve, **sizes, **settings}
    )
    layer = Mapper(config).tsdf
    for scan, pose in zip(case.scans, case.poses, strict=True):
        layer.insert(scan, pose)
    mesh, summary = layer.mesh(), layer.summary()
    return {
        'case': case.name,
        'who': 'surfel_mapper, carving' if carve else 'surfel_mapper',
        'share': share(case, mesh.vertices, mesh.triangles),
        'triangles': len(mesh),
        'sensor': next(iter(summary['sensors'].values()), 'none'),
        'fit': next(iter(summary['sensor_fit'].values()), None),
        'by_points': summary['scans_by_points'],
        'scans': len(case.scans),
    }


def peer_rows(case: Case, options: Options) -> list[Row]:
    """Return the row of VDBFusion."""
    directory = options.cache / 'clouds'
    directory.mkdir(parents=True, exist_ok=True)
    files = []
    for number, scan in enumerate(case.scans):
        files.append(directory / f'{number:05d}.npy')
        np.save(files[-1], scan.points[in_range(scan.points)])
    settings = {'voxel_size_m': VOXEL_M, 'truncation_m': TRUNCATION_M, 'carve': False, 'meshes': 1}
    try:
        _, mesh, _ = run_tsdf(VDBFUSION, options.cache, files, np.array(case.poses), settings)
    except PeerError as error:
        return [{'case': case.name, 'who': f'{VDBFUSION.name}, not measured: {error}'}]
    found = {'share': share(case, *mesh), 'triangles': len(mesh[1])}
    return [{'case': case.name, 'who': VDBFUSION.name, **found, 'scans': len(files)}]


def share(case: Case, vertices: npt.NDArray[Any], triangles: npt.NDArray[Any]) -> float:
    """Return the share of the checked points that are near the mesh; 0 without triangles."""
    if not len(triangles):
        return 0.0
    points = case.checked[:: -(-len(case.checked) // MOST_CHECKED)]
    corners = np.asarray(vertices, np.float64)[triangles]
    return float((distances_to_mesh(points, corners, VOXEL_M) <= NEAR_VOXELS * VOXEL_M).mean())


def in_range(points: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Return which points (N, 3) are within the range of the field."""
    range_m = np.linalg.norm(points.astype(np.float64), axis=1)
    found: npt.NDArray[np.bool_] = (range_m >= MIN_RANGE_M) & (range_m <= MAX_RANGE_M)
    return found


def cases(options: Options) -> Iterator[Case]:
    """Yield the clouds of real sensors, then simulated ones."""
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    for name, file in REAL.items() if data else ():
        path = Path(data or '') / 'data/scans' / file
        if path.exists():
            yield real_case(name, path)
    yield from street_clouds(options)
    yield poles()


def real_case(name: str, path: Path) -> Case:
    """Return the case of one scan in a file; invalid points as the file has them."""
    points, columns = read_scan(path)
    points = np.ascontiguousarray(points, np.float32)
    found = {'ring': columns['ring']} if 'ring' in columns and 'without' not in name else {}
    scan = Scan(points=points, stamp_ns=0, frame_id='lidar', columns=found)
    used = points[in_range(points)].astype(np.float64)
    return Case(name=name, scans=[scan], poses=[np.eye(4)], checked=used, settings={})


def street_clouds(options: Options) -> Iterator[Case]:
    """Yield the street seen by a lidar, its clouds in other forms."""
    street = Simulation(
        World.street(seed=1, length_m=60.0),
        Lidar(beams=options.beams, columns=options.columns, range_noise_m=0.02),
    )
    numbers = range(5)
    scans = [street.scan(number) for number in numbers]
    poses = [street.drive.T_odom_sensor(scan.stamp_ns) for scan in scans]
    whole = [scan.select(in_range(scan.points)) for scan in scans]
    checked = np.concatenate([map_points(*each) for each in zip(whole, poses, strict=True)])
    with_ring = [ringed(scan, scan.columns['ring']) for scan in scans]
    plain = {'poses': poses, 'checked': checked, 'settings': {}}
    yield Case(name='street, 64 beams', scans=with_ring, **plain)

    azimuth = np.arctan2(scans[0].points[:, 1], scans[0].points[:, 0])
    partial = ringed(scans[0].select(azimuth > np.pi / 3.0))
    yield Case(
        name='street, first sweep partial', scans=[partial, *map(ringed, scans[1:])], **plain
    )
    missing = ~np.isfinite(scans[0].points).all(axis=1)
    zeros = [ringed(s, np.where(missing_of(s), 0, s.columns['ring'])) for s in scans]
    assert missing.any()
    yield Case(name='street, missing points with ring 0', scans=zeros, **plain)

    T_base_sensor = np.eye(4)
    T_base_sensor[:3, 3] = (0.0, 0.0, 1.8)
    mounted = [ringed(replace(s, points=s.points + np.float32([0.0, 0.0, 1.8]))) for s in scans]
    at_base = [pose @ np.linalg.inv(T_base_sensor) for pose in poses]
    yield Case(name='street in base_link', scans=mounted, poses=at_base, checked=checked)


def missing_of(scan: Scan) -> npt.NDArray[np.bool_]:
    """Return which rays of a scan had no return, (N,) bool."""
    found: npt.NDArray[np.bool_] = ~np.isfinite(scan.points).all(axis=1)
    return found


def ringed(scan: Scan, ring: npt.NDArray[Any] | None = None) -> Scan:
    """Return a scan with this column only, or none."""
    return replace(scan, columns={} if ring is None else {'ring': ring})


def map_points(scan: Scan, T_map_sensor: FloatArray) -> FloatArray:
    """Return the points of a scan in the map frame, m."""
    found: FloatArray = scan.points.astype(np.float64) @ T_map_sensor[:3, :3].T
    return found + T_map_sensor[:3, 3]


def poles() -> Case:
    """Return poles of 5 cm in an empty yard; only points on them count."""
    ground = Primitive(kind='rectangle', size_m=(80.0, 80.0))
    yard = Primitive(kind='tube', size_m=(30.0, 12.0))
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    distance = np.tile([4.0, 7.0, 10.0, 14.0], 6)
    posts = [
        Primitive(kind='cylinder', size_m=(0.025, 3.0), xyz=(r * np.cos(a), r * np.sin(a), 1.5))
        for r, a in zip(distance.tolist(), angles.tolist(), strict=True)
    ]
    world, lidar = World([ground, yard, *posts]), Lidar(range_noise_m=0.02)
    scans, poses, checked = [], [], []
    for number in range(5):
        pose = np.eye(4)
        pose[:3, 3] = (0.3 * number, 0.0, 1.8)
        scan = lidar.scan(world, pose, stamp_ns=number * 10**8, number=number)
        scans.append(ringed(scan))
        poses.append(pose)
        surface = scan.columns['surface']
        on_post = (surface >= 0) & (world.primitive_of(np.maximum(surface, 0)) >= 2)
        checked.append(map_points(scan.select(on_post), pose))
    return Case(
        name='poles of 5 cm',
        scans=scans,
        poses=poses,
        checked=np.concatenate(checked),
        settings={},
    )
