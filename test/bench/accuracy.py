# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Errors of normals on the street, beside normals from k nearest neighbours.

The points of some scans are mapped at their true poses; the truth is the normal of the surface
nearest to the position of a normal. ``surfels``: at every surfel of at least 5 points; other
packages at the point nearest to it. ``points``: at points drawn at random from such surfels; ours
is the normal of the surfel of the point. Support is equal: k is the median number of points of a
surfel. Angles are between axes, as some packages do not orient normals.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from surfel_mapper.mapping.surfel_map import SurfelMap
from test.bench.options import Options
from test.bench.peers import NORMAL_PEERS
from test.bench.peers.run import environment, PeerError, run_normals
from test.bench.report import Row
from test.bench.street import Street

NUM_SCANS = 10
NUM_POINTS = 20_000
MIN_POINTS = 5

Floats = npt.NDArray[np.float64]


def run(options: Options) -> list[Row]:
    """Return a row for each package, by voxel size and place."""
    street = Street(options)
    street.prepare(NUM_SCANS)
    rows: list[Row] = []
    for size_m in options.voxel_sizes_m:
        points, surfel_map = mapped(street, size_m)
        surfels = surfel_map.surfels(MIN_POINTS)
        support = int(np.median(surfels.num_points))
        held = surfel_map.index(MIN_POINTS).at(points)
        rng = np.random.default_rng(0)
        inside = np.flatnonzero(held >= 0)
        drawn = rng.choice(inside, min(NUM_POINTS, len(inside)), replace=False)
        _, nearest = cKDTree(points).query(surfels.position)
        normals = {'surfel_mapper': (surfels.normal, surfels.normal[held[drawn]])}
        missing: list[Row] = []
        for peer in NORMAL_PEERS if options.peers else ():
            try:
                found = run_normals(environment(peer, options.cache), peer, points, support)
                normals[peer.name] = (found[nearest], found[drawn])
            except PeerError as error:
                missing.append({'who': peer.name, 'note': f'not measured: {error}'})
        for place, at in enumerate((surfels.position, points[drawn])):
            truth = street.simulation.world.normal_at(at)
            facts = {'voxel_m': size_m, 'support': support, 'at': ('surfels', 'points')[place]}
            rows += [
                {**facts, 'who': who, **errors(values[place], truth)}
                for who, values in normals.items()
            ]
        rows += missing
    return rows


def mapped(street: Street, size_m: float) -> tuple[Floats, SurfelMap]:
    """Return the points of the scans in the map frame, (N, 3), and their map."""
    surfel_map, parts = SurfelMap(size_m), []
    for number in range(NUM_SCANS):
        pose, points = street.pose(number), street.points(number).astype(np.float64)
        points = points[np.isfinite(points).all(axis=1)] @ pose[:3, :3].T + pose[:3, 3]
        surfel_map.add(points, pose[:3, 3])
        parts.append(points)
    return np.concatenate(parts), surfel_map


def errors(normals: Floats, truth: Floats) -> Row:
    """Return mean, median and 95th percentile of the angles between axes, deg."""
    cross = np.linalg.norm(np.cross(normals, truth), axis=1)
    degrees = np.degrees(np.arctan2(cross, np.abs((normals * truth).sum(axis=1))))
    known = degrees[np.isfinite(degrees)]
    return {
        'num': len(known),
        'unknown': len(degrees) - len(known),
        'mean_deg': float(known.mean()),
        'median_deg': float(np.median(known)),
        'p95_deg': float(np.percentile(known, 95)),
    }
