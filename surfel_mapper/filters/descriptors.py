# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Filters that add columns or select by them, one point at a time: no neighbours, no groups."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError, FilterError
from surfel_mapper.filters.base import Filter, Mask, parameter, with_columns
from surfel_mapper.filters.columns import (
    EIGEN_VALUES,
    INCIDENCE_ANGLES,
    NORMALS,
    OBSERVATION_DIRECTIONS,
    with_normals,
)
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan

TIME_COLUMNS = ('t', 'time', 'times', 'timestamp', 'time_stamp', 'timeStamp', 'offset_time')
"""Names that drivers give to the time of a point."""

Array = npt.NDArray[Any]

MAX_COMPONENTS = 2**32 - 1


@register(libpointmatcher='AddDescriptorDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class AddDescriptor(Filter):
    """Give every point the same value, in a new column or in place of one of the same name."""

    column_name: str = parameter(
        'testDescriptor', 'Name of the column.', libpointmatcher='descriptorName'
    )
    num_components: int = parameter(
        1, 'Numbers a point.', low=1, high=MAX_COMPONENTS, libpointmatcher='descriptorDimension'
    )
    values: tuple[float, ...] = parameter(
        (), 'The value, num_components numbers.', items=float, libpointmatcher='descriptorValues'
    )

    def check(self) -> None:
        """Refuse another number of values than num_components."""
        if len(self.values) != self.num_components:
            raise ConfigError(
                f'{self.name}: values (descriptorValues): {len(self.values)} numbers, expected '
                f'num_components (descriptorDimension) = {self.num_components}'
            )
        if not self.column_name:
            raise ConfigError(f'{self.name}: column_name (descriptorName): empty')

    def apply(self, scan: Scan) -> Scan:
        """Return the scan with the column; one of another number of components is not replaced."""
        if self.column_name in scan.columns:
            num_present = math.prod(scan.columns[self.column_name].shape[1:])
            if num_present != self.num_components:
                raise FilterError(
                    f'the points have a column {self.column_name!r} of {num_present} components, '
                    f'expected {self.num_components}; choose another column_name'
                )
        column = np.empty((len(scan), self.num_components), scan.points.dtype)
        column[:] = self.values
        return with_columns(
            scan, **{self.column_name: column[:, 0] if self.num_components == 1 else column}
        )


@register(libpointmatcher='CutAtDescriptorThresholdDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class CutAtDescriptorThreshold(Filter):
    """Drop the points whose column is above, or below, a limit; those at it stay."""

    column_name: str = parameter(
        'none',
        'Name of the column; if it has several components, the first.',
        libpointmatcher='descName',
    )
    use_larger_than: bool = parameter(
        True,
        '1: drop points above the limit; 0: drop points below it.',
        libpointmatcher='useLargerThan',
    )
    threshold: float = parameter(0.0, 'The limit.', libpointmatcher='threshold')

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; those with nan do not."""
        values = self.column(scan, self.column_name)
        first = values if values.ndim == 1 else values.reshape(len(values), -1)[:, 0]
        if self.use_larger_than:
            return np.asarray(first <= self.threshold, np.bool_)
        return np.asarray(first >= self.threshold, np.bool_)


@register(libpointmatcher='ObservationDirectionDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationDirection(Filter):
    """Add observationDirections, from each point to the sensor, m."""

    x_m: float = parameter(
        0.0, 'x of the sensor in the frame of the points, m.', libpointmatcher='x'
    )
    y_m: float = parameter(0.0, 'y of the sensor, m.', libpointmatcher='y')
    z_m: float = parameter(0.0, 'z of the sensor, m.', libpointmatcher='z')

    def apply(self, scan: Scan) -> Scan:
        """Return the scan with the column."""
        sensor = np.array([self.x_m, self.y_m, self.z_m], scan.points.dtype)
        return with_columns(scan, **{OBSERVATION_DIRECTIONS: sensor - scan.points})


@register(libpointmatcher='OrientNormalsDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class OrientNormals(Filter):
    """Turn the normals towards the sensor, or away from it; needs observationDirections."""

    toward_sensor: bool = parameter(
        True, '1: towards the sensor; 0: away from it.', libpointmatcher='towardCenter'
    )

    def apply(self, scan: Scan) -> Scan:
        """Return the scan with the normals turned; those at a right angle are unchanged."""
        scan = with_normals(scan)
        normals = self.column(scan, NORMALS)
        along = dot(normals, self.column(scan, OBSERVATION_DIRECTIONS))
        wrong = along < 0.0 if self.toward_sensor else along > 0.0
        return with_columns(scan, normals=np.where(wrong[:, None], -normals, normals))


@register(libpointmatcher='IncidenceAngleDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class IncidenceAngle(Filter):
    """Add incidenceAngles, between normal and observation direction, 0 to pi rad."""

    def apply(self, scan: Scan) -> Scan:
        """Return the scan with the column; nan for directions of length 0."""
        scan = with_normals(scan)
        normals = self.column(scan, NORMALS)
        cosine = dot(normals, unit(self.column(scan, OBSERVATION_DIRECTIONS)))
        angles = np.arccos(np.clip(cosine, -1.0, 1.0))  # rounding may exceed 1
        return with_columns(scan, **{INCIDENCE_ANGLES: angles.astype(scan.points.dtype)})


def dot(a: Array, b: Array) -> Array:
    """Return the scalar products of rows, in float64 and added in the order x, y, z."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def unit(vectors: Array) -> Array:
    """Return rows scaled to unit length, in float64; nan for rows of length 0 or inf."""
    vectors = vectors.astype(np.float64)
    length = np.sqrt(dot(vectors, vectors))[:, None]
    has_length = (length > 0.0) & np.isfinite(length)
    result = np.full_like(vectors, np.nan)
    np.divide(vectors, length, out=result, where=has_length)
    return result


@register(libpointmatcher='SphericalityDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class Sphericality(Filter):
    """Add sphericality, -1 on a plane to 1 in a ball; needs three eigValues."""

    keep_unstructureness: bool = parameter(
        False,
        'Add unstructureness, its part for a ball.',
        libpointmatcher='keepUnstructureness',
    )
    keep_structureness: bool = parameter(
        False,
        'Add structureness, its part for a plane.',
        libpointmatcher='keepStructureness',
    )

    def apply(self, scan: Scan) -> Scan:
        """
        Return the scan with the columns.

        With eigenvalues e0 <= e1 <= e2 unstructureness is e0 / e2, structureness is
        e1 / e2 (e1 - e0) / sqrt(e0^2 + e1^2), and sphericality is their difference. On a line
        all are 0; they are nan if e2 is 0 or an eigenvalue is negative.

        Source: Kubelka et al. 2020, Radio propagation models for differential GNSS based on
        dense point clouds, equation 1.
        """
        values = self.column(scan, EIGEN_VALUES)
        if values.shape != (len(scan), 3):
            raise FilterError(f'{EIGEN_VALUES}: shape {values.shape}, expected (N, 3)')
        e0, e1, e2 = np.sort(values.astype(np.float64), axis=1).T
        with np.errstate(divide='ignore', invalid='ignore'):
            unstructured = e0 / e2
            structured = e1 / e2 * ((e1 - e0) / np.hypot(e0, e1))
        line, undefined = e1 <= 0.0, ~((e2 > 0.0) & (e0 >= 0.0))
        for ratio in (unstructured, structured):
            ratio[line] = 0.0
            ratio[undefined] = np.nan
        columns = {'sphericality': unstructured - structured}
        if self.keep_unstructureness:
            columns['unstructureness'] = unstructured
        if self.keep_structureness:
            columns['structureness'] = structured
        dtype = scan.points.dtype
        return with_columns(scan, **{name: ratio.astype(dtype) for name, ratio in columns.items()})


@register
@dataclass(frozen=True, slots=True, kw_only=True)
class LabelMask(Filter):
    """Drop, or keep, the points that have one of some labels."""

    labels: tuple[int, ...] = parameter((), 'The labels.', items=int)
    remove: bool = parameter(True, '1: drop the points that have one of them; 0: keep only those.')
    column_name: str = parameter('label', 'Column of the labels.')

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay."""
        labels = self.column(scan, self.column_name)
        listed = np.zeros(len(scan), np.bool_)
        for label in self.labels:  # for few labels a third of the time of np.isin
            listed |= labels == label
        return ~listed if self.remove else listed


def times_of(scan: Scan) -> npt.NDArray[Any]:
    """Return the times of the points in the unit of their column."""
    for name in TIME_COLUMNS:
        if name in scan.columns:
            times = scan.columns[name]
            return times if times.dtype.kind == 'f' else times.astype(np.int64)
    have = ', '.join(scan.columns) or 'none'
    raise FilterError(
        f'needs the times of the points ({", ".join(TIME_COLUMNS)}); the points have {have}'
    )
