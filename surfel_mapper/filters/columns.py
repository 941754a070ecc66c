# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The columns that filters share: their names, their shapes, and how several points become one.

A descriptor of libpointmatcher is a column of the same name, so that chains which name one run
as they are; a descriptor of one row is a column (N,), of C rows (N, C). Its times are a column as
any other. Clouds often bring the normal as three fields; ``normals`` takes those as well.

Where points are merged, a column is averaged by what it is:

- directions (normals): mean, then made unit length again; where opposite ones cancel, the first;
- labels, identities, eigenvectors: the first, for a mean of them is none of them;
- colours packed into one number: the mean of each channel;
- whole numbers of 64 bits, which are times: the mean towards zero, exact and without overflow;
- other whole numbers: the mean, rounded; booleans: whether half of them or more hold;
- all else: the mean, in float64.
"""

from __future__ import annotations

from dataclasses import replace
import enum
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.scan import Scan

NORMALS = 'normals'
"""(N, 3) unit normals."""
OBSERVATION_DIRECTIONS = 'observationDirections'
"""(N, 3) from the point to the sensor, m, not of unit length."""
DENSITIES = 'densities'
"""(N,) points per m^3 about the point."""
EIGEN_VALUES = 'eigValues'
"""(N, 3) of the covariance about the point, m^2, ascending where sorted."""
EIGEN_VECTORS = 'eigVectors'
"""(N, 9) their unit eigenvectors, one after another."""
INCIDENCE_ANGLES = 'incidenceAngles'
"""(N,) between normal and direction to the sensor, rad."""
MATCHED_IDS = 'matchedIds'
"""(N, K) indices of neighbours."""
MEAN_DISTS = 'meanDists'
"""(N,) mean distance to the neighbours, m."""
SENSOR_NOISE = 'simpleSensorNoise'
"""(N,) noise radius of the sensor, m."""


class Kind(enum.Enum):
    """What a column is, as far as merging it goes."""

    NUMBER = 'number'
    DIRECTION = 'direction'
    FIRST = 'first'
    COLOUR = 'colour'
    TIME = 'time'


KINDS = {
    NORMALS: Kind.DIRECTION,
    EIGEN_VECTORS: Kind.FIRST,
    MATCHED_IDS: Kind.FIRST,
    **dict.fromkeys(('rgb', 'rgba'), Kind.COLOUR),
    **dict.fromkeys(('label', 'labels', 'class', 'instance', 'object', 'id', 'tag'), Kind.FIRST),
    **dict.fromkeys(('ring', 'line', 'channel', 'laser_id', 'return_type'), Kind.FIRST),
}
"""Kind of the columns of these names; of all others it follows from their type."""

NORMAL_FIELDS = ('normal_x', 'normal_y', 'normal_z')
"""The normal as clouds bring it."""


def kind_of(name: str, column: npt.NDArray[Any]) -> Kind:
    """Return what a column is."""
    if name in KINDS:
        return KINDS[name]
    if column.dtype.kind in 'fiub':
        return Kind.TIME if column.dtype in (np.int64, np.uint64) else Kind.NUMBER
    return Kind.FIRST


def with_normals(scan: Scan) -> Scan:
    """Return the scan with the column ``normals`` if it has the normal as three fields only."""
    if NORMALS in scan.columns or any(name not in scan.columns for name in NORMAL_FIELDS):
        return scan
    normals = np.column_stack([scan.columns[name] for name in NORMAL_FIELDS])
    others = {k: v for k, v in scan.columns.items() if k not in NORMAL_FIELDS}
    return replace(scan, columns={**others, NORMALS: normals})
