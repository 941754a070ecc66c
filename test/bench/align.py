# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The window aligned on the street, mapped by an odometry that drifts by 1 % and 0.05 deg a metre.

Errors are means of the relative poses of scans a stated number apart. ``thick_mm`` is
the root of the mean smallest eigenvalue of flat surfels of 50 points and more: the remains of
range noise and of the unevenness inside voxels at ``true poses``, more where scans disagree.
``again`` is the time of aligning a window whose older scans are aligned already.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.geometry import q_xyzw
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from test.alignment.street import drifted, relative_errors
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.report import Row
from test.bench.street import Street

SENSOR = 'lidar'
FLAT, MIN_POINTS = 0.5, 50

Floats = npt.NDArray[np.float64]


def run(options: Options) -> list[Row]:
    """Return rows for the true, drifting and aligned poses, with the time."""
    street = Street(options)
    street.prepare(options.window)
    true = np.array([street.pose(number) for number in range(options.window)])
    drift = drifted(true)
    with one_core():
        mapper = mapped(street, drift)
        mapper.warm_up()
        times = [timed(mapper), timed(mapper)]
    found = np.array([scan.T_map_sensor for scan in mapper.window])
    poses = {'true poses': true, 'odometry': drift, 'aligned': found}
    rows = [
        {'poses': name, **errors(some, true), 'thick_mm': thickness_mm(street, some)}
        for name, some in poses.items()
    ]
    rows[-1] = {**rows[-1], 'align_ms': times[0], 'again_ms': times[1]}
    return list(rows)


def mapped(street: Street, poses: Floats) -> Mapper:
    """Return a mapper with scans mapped at poses, whose points it keeps."""
    settings = {'max_scans': len(poses), 'keep_points': True}
    pose = {'source': 'odometry'}
    frames = {'base': SENSOR}
    mapper = Mapper(Config.from_mapping({'window': settings, 'pose': pose, 'frames': frames}))
    for number, T in enumerate(poses):
        stamp_ns = street.simulation.stamp_ns(number)
        mapper.add_pose('odom', SENSOR, stamp_ns, T[:3, 3], q_xyzw(T))
        points = np.asarray(street.points(number))
        mapper.add_scan(Scan(points=points, stamp_ns=stamp_ns, frame_id=SENSOR))
        list(mapper.insert_ready())
    return mapper


def timed(mapper: Mapper) -> float:
    """Align; return the milliseconds."""
    start = perf_counter()
    mapper.align()
    return (perf_counter() - start) * 1e3


def errors(poses: Floats, true: Floats) -> Row:
    """Return errors a step, and over ten steps and all, mm and deg."""
    row: dict[str, float] = {}
    for apart in (1, 10, len(true) - 1):
        distance_m, angle_rad = relative_errors(poses, true, apart)
        row |= {f'mm_{apart}': 1e3 * distance_m, f'deg_{apart}': float(np.degrees(angle_rad))}
    return row


def thickness_mm(street: Street, poses: Floats) -> float:
    """Return the thickness of flat surfels of scans mapped at poses."""
    surfel_map = SurfelMap(0.5)
    for number, T in enumerate(poses):
        surfel_map.insert(surfel_map.reduce(street.points(number), T, origin=T[:3, 3]))
    surfels = surfel_map.surfels(MIN_POINTS)
    return 1e3 * float(np.sqrt(surfels.eigenvalues[surfels.planarity > FLAT, 0].mean()))
