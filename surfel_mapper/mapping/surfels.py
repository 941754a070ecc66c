# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfels: position, normal and shape of the voxels of a map, as arrays.

Derived from the exact moments in float64 on request, and only for the requested voxels; a map
does not store them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
import logging
import math
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
import numpy.typing as npt

from surfel_mapper import map_formats
from surfel_mapper.arguments import as_array, made_array
from surfel_mapper.errors import DependencyError

logger = logging.getLogger(__name__)

FLOAT_REACH_M = 8192.0
"""Coordinates to which float32 is exact to 0.5 mm."""

QUALITY = ('thickness', 'normal_sigma', 'radius', 'num_scans', 'size')
"""Names of the columns that tell how good a surfel is."""

COVARIANCE = ('cov_xx', 'cov_xy', 'cov_xz', 'cov_yy', 'cov_yz', 'cov_zz')

GOOD_THICKNESS_M, GOOD_SIGMA_RAD, GOOD_SCANS = 0.028, 0.13, 3
"""Limits of a good surfel, chosen on two parts of a hall and in a city. A single scan often sees
one of two surfaces only: of its surfels within the first two limits up to 19 % are off by more
than 10 deg."""

NOISE_SQ = 0.01**2
"""Smallest variance of points about their plane that normal_sigma assumes, m^2: also a thin surfel
has the errors of range and pose that its points share."""

REPEATED = 3.0
"""Number of points that count as one for normal_sigma, as points side by side share errors: in
one-plane voxels of a hall it is then within a factor of two of the measured angle."""

RIGHT_ANGLE = math.pi / 2.0
"""Largest normal_sigma, rad: the normal is undetermined."""

Columns = dict[str, npt.NDArray[Any]]

Quality = tuple[npt.NDArray[np.float64], ...]
"""Thickness, normal_sigma and radius, (K,) each."""


class OneSurfel(NamedTuple):
    """One row of Surfels; see there for units."""

    position: npt.NDArray[np.float64]
    normal: npt.NDArray[np.float64]
    planarity: float
    curvature: float
    eigenvalues: npt.NDArray[np.float64]
    num_points: int
    voxel_index: tuple[int, int, int]
    thickness: float
    normal_sigma: float
    radius: float
    num_scans: int
    size: float


class QualityColumn:
    """
    A column of Surfels that follows from eigenvalues and counts.

    Its first reading derives all three, which most callers never read. Only operations that every
    machine rounds alike are used.

    Source: Anderson 1963 (Asymptotic theory for principal component analysis) for the standard
    error of an eigenvector.
    """

    def __init__(self, number: int) -> None:
        self._number = number

    def __get__(self, surfels: Surfels, owner: type[Surfels]) -> npt.NDArray[np.float64]:
        """Return the column, (K,)."""
        quality = surfels.quality
        if quality is None:
            e0, e1, e2 = np.ascontiguousarray(surfels.eigenvalues.T)
            n = surfels.num_points.astype(np.float64)
            is_determined = n > 3.0  # three parameters of a plane
            with np.errstate(divide='ignore', invalid='ignore'):
                variance = np.where(is_determined, e0 * (n - 1.0) / (n - 3.0), np.nan)
                noise_sq = np.fmax(variance, NOISE_SQ)
                first, second = e1 - noise_sq, e2 - noise_sq
                first_sq, second_sq = first * first, second * second
                spread = REPEATED * noise_sq * (e1 * second_sq + e2 * first_sq)
                sigma = np.sqrt(spread / ((n - 1.0) * (first_sq * second_sq)))
                sigma = np.where((first > 0.0) & (sigma < RIGHT_ANGLE), sigma, RIGHT_ANGLE)
                sigma = np.where(is_determined & (e2 > 0.0), sigma, np.nan)
                quality = np.sqrt(variance), sigma, np.sqrt(2.0 * (e1 + e2))
            object.__setattr__(surfels, 'quality', quality)
        return quality[self._number]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Surfels:
    """
    Surfels of K voxels, a row each, in the frame of the map.

    ``len``, iteration and ``surfels[row]`` give single surfels, ``surfels[mask]`` and slices
    Surfels.

    Attributes
    ----------
    position : (K, 3) float64, m
        Mean of the points.
    normal : (K, 3) float64
        Unit eigenvector of the smallest eigenvalue, turned towards the sensor. If its position
        is unknown, the component of largest magnitude is positive. nan for a single point and
        for identical points.
    planarity : (K,) float64
        2 (e1 - e0) / (e0 + e1 + e2) in [0, 1]; nan if the normal is nan.
    curvature : (K,) float64
        e0 / (e0 + e1 + e2) in [0, 1/3] (Pauly et al. 2002); nan if the normal is nan.
    eigenvalues : (K, 3) float64, m^2
        Eigenvalues of the covariance scatter / (n - 1), ascending; 0 for a single point.
    num_points : (K,) int64
        Number of points.
    voxel_index : (K, 3) int32
        floor(point / voxel size).
    num_scans : (K,) int64
        Number of scans with points in the voxel, exact if scans are removed as they were added; of
        a coarser voxel the largest of its voxels.
    size : (K,) float64, m
        Edge of the voxel, or of the cell of adaptive surfels.
    thickness : (K,) float64, m
        Standard deviation of the points along the normal about their plane. It is the square root
        of e0 (n - 1) / (n - 3): fitting the plane takes three of the n degrees of freedom. It is
        nan for 3 points or fewer.
    normal_sigma : (K,) float64, rad
        Standard error of the normal; pi/2, the largest value, if it is undetermined. It is the
        square root of the sum of 3 s e_i / ((n - 1) (e_i - s)^2) for i = 1, 2. s is thickness^2,
        at least 0.01^2 m^2. The 3 stands for errors that points share (Anderson 1963 without it).
        It is nan for 3 points or fewer, and if the normal is nan.
    radius : (K,) float64, m
        Radius of the uniform disc of equal spread in the plane: the square root of 2 (e1 + e2).
    covariance : (K, 6) float64, m^2, optional
        Covariance of the points, xx xy xz yy yz zz, if asked for.
    channels : mapping of str to (K,) float64
        Means of the channels of the map: ``intensity``; ``red``, ``green``, ``blue`` in 0 to 255.
    quality : tuple of (K,) float64, optional
        thickness, normal_sigma and radius, if known without the eigenvalues.

    Examples
    --------
    >>> import numpy as np
    >>> from surfel_mapper import SurfelMap
    >>> surfel_map = SurfelMap(0.5)
    >>> _ = surfel_map.add(np.random.default_rng(0).uniform(0, [2, 2, 0.1], (1000, 3)))
    >>> surfels = surfel_map.surfels(min_points=5)
    >>> surfels.position.shape, len(surfels[surfels.num_points > 1000])
    ((16, 3), 0)
    >>> [surfel.voxel_index for surfel in surfels if max(surfel.voxel_index) == 0]
    [(0, 0, 0)]

    """

    position: npt.NDArray[np.float64]
    normal: npt.NDArray[np.float64]
    planarity: npt.NDArray[np.float64]
    curvature: npt.NDArray[np.float64]
    eigenvalues: npt.NDArray[np.float64]
    num_points: npt.NDArray[np.int64]
    voxel_index: npt.NDArray[np.int32]
    num_scans: npt.NDArray[np.int64]
    size: npt.NDArray[np.float64]
    covariance: npt.NDArray[np.float64] | None = None
    channels: Mapping[str, npt.NDArray[np.float64]] = field(default_factory=dict)
    quality: Quality | None = None

    thickness = QualityColumn(0)
    normal_sigma = QualityColumn(1)
    radius = QualityColumn(2)

    @classmethod
    def from_message(cls, msg: Any) -> Surfels:
        """
        Return the surfels of a message of a node, of its topics ~/normals or ~/changed.

        Parameters
        ----------
        msg : sensor_msgs/PointCloud2
            From rclpy or rosbags, or any object with these attributes. Rows without points, which
            ~/changed has with ``publish.moments``, are left out.

        Returns
        -------
        Surfels
            float32 values as float64. The message has no eigenvalues: they are nan. Without
            ``publish.moments`` it has no ``voxel_index`` either, which is -2^31 then. It has
            covariances with ``publish.covariance``. Of messages of earlier versions thickness,
            normal_sigma, radius and size are nan, num_scans is 0.

        Raises
        ------
        CloudFormatError
            If it is no PointCloud2, or lacks a field of ~/normals.

        """
        surfels: Surfels = map_formats.registered('messages').surfels_in(msg)
        return surfels

    @property
    def is_good(self) -> npt.NDArray[np.bool_]:
        """
        Whether each surfel can be trusted, (K,) bool.

        The rule, for all sizes of voxels: ``thickness < 0.028`` (m), ``normal_sigma < 0.13``
        (rad), ``num_scans >= 3``. No surfel of a single scan is good.

        Notes
        -----
        Measured against fits of two planes to the dense points of each voxel, at 0.5 and 0.2 m.
        At least 90 % of the voxels on one plane are good, in two parts of a hall and in a city.
        At most 1.8 % of the good surfels are off by more than 10 deg in the hall, 2.6 % in the
        city. ``planarity > 0.7`` keeps 67 % and selects up to 3.9 %. Voxels of 0.2 m with few
        points do not determine their plane: a quarter of the good ones cannot be judged.
        Source: ``python -m test.bench --only quality``.

        """
        return self.is_flat & (self.num_scans >= GOOD_SCANS)

    @property
    def is_flat(self) -> npt.NDArray[np.bool_]:
        """
        Whether each surfel is good but for its number of scans, (K,) bool.

        For maps of few scans, of which more are wrong, and of merged clouds, which count as one.
        """
        is_thin = self.thickness < GOOD_THICKNESS_M
        return np.asarray(is_thin & (self.normal_sigma < GOOD_SIGMA_RAD))

    def __len__(self) -> int:
        """Return the number of surfels."""
        return len(self.num_points)

    def __repr__(self) -> str:
        """Return the number of surfels and the box around them."""
        if not len(self):
            return 'Surfels(0)'
        low, high = (np.round(f(self.position, axis=0), 2).tolist() for f in (np.min, np.max))
        return f'Surfels({len(self)}, from {low} to {high} m)'

    @overload
    def __getitem__(self, row: int | np.integer[Any]) -> OneSurfel: ...

    @overload
    def __getitem__(self, row: slice | Sequence[int] | npt.NDArray[Any]) -> Surfels: ...

    def __getitem__(self, row: Any) -> Any:
        """Return one surfel (OneSurfel) for an integer, Surfels for a slice, mask or rows."""
        if isinstance(row, bool) or not isinstance(row, (int, np.integer)):
            return self.select(row)
        if not 0 <= row < len(self):
            raise IndexError(no_row(int(row), len(self)))
        values = {name: getattr(self, name)[row] for name in OneSurfel._fields}
        numbers = {name: value.item() for name, value in values.items() if value.ndim == 0}
        index = tuple(values['voxel_index'].tolist())
        return OneSurfel(**{**values, **numbers, 'voxel_index': index})

    def __iter__(self) -> Iterator[OneSurfel]:
        """Yield the surfels one by one."""
        return (self[row] for row in range(len(self)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Return ``to_numpy()`` for np.asarray."""
        return made_array(self.to_numpy(), dtype, copy)

    def to_numpy(self) -> npt.NDArray[Any]:
        """
        Return the surfels as a structured array of shape (K,).

        Fields x y z, normal_x normal_y normal_z, planarity, curvature, e0 e1 e2, num_points,
        i j k, thickness, normal_sigma, radius, num_scans, size. With covariances also cov_xx ...
        cov_zz, and the channels. ``to_pandas`` has columns of these names.
        """
        columns = self._columns()
        table = np.empty(len(self), [(name, values.dtype) for name, values in columns.items()])
        for name, values in columns.items():
            table[name] = values
        return table

    def to_pandas(self) -> Any:
        """
        Return the surfels as a pandas DataFrame, with the columns of ``to_numpy``.

        Raises
        ------
        DependencyError
            If pandas is not installed.

        """
        try:
            import pandas
        except ImportError as error:
            reason = f'pandas cannot be loaded ({error}); pip install pandas'
            raise DependencyError(reason) from error
        return pandas.DataFrame(self._columns())

    def to_open3d(self) -> Any:
        """
        Return the surfels as an open3d.geometry.PointCloud with normals, and colours if known.

        Raises
        ------
        DependencyError
            If Open3D is not installed.

        """
        try:
            import open3d
        except ImportError as error:
            reason = f'Open3D cannot be loaded ({error}); pip install open3d'
            raise DependencyError(reason) from error
        cloud = open3d.geometry.PointCloud()
        cloud.points = open3d.utility.Vector3dVector(self.position)
        cloud.normals = open3d.utility.Vector3dVector(self.normal)
        if 'red' in self.channels:
            colours = [self.channels[name] / 255.0 for name in ('red', 'green', 'blue')]
            cloud.colors = open3d.utility.Vector3dVector(np.stack(colours, axis=1))
        return cloud

    def _columns(self) -> dict[str, npt.NDArray[Any]]:
        """Return all columns, (K,) each, by name."""
        covariance = {}
        if self.covariance is not None:
            covariance = dict(zip(COVARIANCE, self.covariance.T, strict=True))
        return {
            **dict(zip('xyz', self.position.T, strict=True)),
            **dict(zip(('normal_x', 'normal_y', 'normal_z'), self.normal.T, strict=True)),
            'planarity': self.planarity,
            'curvature': self.curvature,
            **dict(zip(('e0', 'e1', 'e2'), self.eigenvalues.T, strict=True)),
            'num_points': self.num_points,
            **dict(zip('ijk', self.voxel_index.T, strict=True)),
            **{name: getattr(self, name) for name in QUALITY},
            **covariance,
            **self.channels,
        }

    def select(self, rows: Any) -> Surfels:
        """
        Return selected surfels: by a slice, a mask (K,) bool or row indices.

        Raises
        ------
        IndexError
            If a row is negative (``SurfelIndex.at`` returns -1 for a voxel without a surfel), or
            beyond the last. If rows are neither whole numbers nor a mask (K,).

        """
        if not isinstance(rows, slice):
            rows = as_array('rows', rows)
            if rows.size == 0 and rows.dtype != np.bool_:
                rows = rows.astype(np.int64)
            if rows.ndim != 1 or rows.dtype.kind not in 'iub':
                raise IndexError(
                    f'rows {rows.dtype} {rows.shape}, expected whole numbers (R,), a mask (K,) or '
                    'a slice; fields are attributes, as surfels.position'
                )
            if rows.dtype == np.bool_:
                if len(rows) != len(self):
                    raise IndexError(f'a mask of {len(rows)}, expected one of {len(self)} surfels')
            elif rows.size and not 0 <= rows.min() <= rows.max() < len(self):
                worst = rows.min() if rows.min() < 0 else rows.max()
                raise IndexError(no_row(int(worst), len(self)))
        arrays: dict[str, Any] = {name: getattr(self, name)[rows] for name in ARRAYS}
        return Surfels(
            **arrays,
            covariance=None if self.covariance is None else self.covariance[rows],
            channels={name: values[rows] for name, values in self.channels.items()},
            quality=self.quality and tuple([values[rows] for values in self.quality]),
        )

    @property
    def arrays(self) -> tuple[npt.NDArray[Any], ...]:
        """All arrays but covariance, channels and quality, in the order of declaration."""
        return tuple([getattr(self, name) for name in ARRAYS])


ARRAYS = tuple([f.name for f in fields(Surfels)][:-3])
"""Names of the arrays that all surfels have."""


def concatenated(tables: Sequence[Surfels]) -> Surfels:
    """Return the surfels of all tables, with covariances if all have them."""
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(table, name) for table in tables]) for name in ARRAYS
    }
    covariances = [table.covariance for table in tables if table.covariance is not None]
    if len(covariances) == len(tables):
        columns['covariance'] = np.concatenate(covariances)
    if any(table.quality for table in tables):
        qualities = [(table.thickness, table.normal_sigma, table.radius) for table in tables]
        columns['quality'] = tuple(map(np.concatenate, zip(*qualities, strict=True)))
    channels = {
        name: np.concatenate([table.channels[name] for table in tables])
        for name in tables[0].channels
    }
    return Surfels(**columns, channels=channels)


def no_row(row: int, num_surfels: int) -> str:
    """Return the sentence that refuses a row."""
    why = ' (index.at returns -1 for a voxel without surfel: leave it out)' if row == -1 else ''
    return f'row {row} of {num_surfels} surfels{why}; expected 0 to {num_surfels - 1}'


def derive(
    slabs: tuple[npt.NDArray[np.int64], npt.NDArray[np.uint32]],
    chosen: npt.NDArray[np.int32],
    voxel_size_m: float,
    bits: int,
    covariance: bool = False,
) -> Surfels:
    """
    Derive the surfels of selected rows of a slab.

    Parameters
    ----------
    slabs : (R, 12) int64 and (R, 2) uint32
        Rows and their stamps, in the layout of kernels/layout.py.
    chosen : (K,) int32
        Rows that hold points.
    voxel_size_m : float
        Edge of a voxel, m.
    bits : int
        A voxel is 2^bits lattice units wide.
    covariance : bool
        With the covariances.

    """
    num = len(chosen)
    arrays = (
        np.empty((num, 3)),
        np.empty((num, 3)),
        np.empty(num),
        np.empty(num),
        np.empty((num, 3)),
        np.empty(num, np.int64),
        np.empty((num, 3), np.int32),
        np.empty(num, np.int64),
    )
    covariances = np.empty((num if covariance else 0, 6))
    size = np.broadcast_to(voxel_size_m, num)  # of eight bytes
    if num:  # readers of files import this module, and need no compiler
        from surfel_mapper.mapping.kernels.surfels import derive_surfels

        derive_surfels(*slabs, chosen, voxel_size_m, bits, (*arrays, covariances))
    return Surfels(*arrays, size, covariance=covariances if covariance else None)


def surfel_columns(surfels: Surfels) -> Columns:
    """
    Return the columns of ~/normals and ~/changed: float32, and uint32 for counts.

    If the map sums them, also the mean intensity, and the mean colour packed as RViz draws it;
    last the covariance, if the surfels have it.
    """
    values = {
        **dict(zip('xyz', surfels.position.T, strict=True)),
        **dict(zip(('normal_x', 'normal_y', 'normal_z'), surfels.normal.T, strict=True)),
        'curvature': surfels.curvature,
        'planarity': surfels.planarity,
    }
    columns: Columns = {}
    for name, column in values.items():
        columns[name] = column.astype(np.float32)
    columns['num_points'] = surfels.num_points.astype(np.uint32)
    columns |= quality_columns(surfels)
    if 'intensity' in surfels.channels:
        columns['intensity'] = surfels.channels['intensity'].astype(np.float32)
    if 'red' in surfels.channels:
        channels = (surfels.channels[name] for name in ('red', 'green', 'blue'))
        columns['rgb'] = packed_rgb(*channels)
    if surfels.covariance is not None:
        columns |= covariance_columns(surfels)
    return columns


def quality_columns(surfels: Surfels) -> Columns:
    """Return the columns of QUALITY for messages and files: float32, and uint32 for num_scans."""
    columns: Columns = {}
    for name in QUALITY:
        dtype = np.uint32 if name == 'num_scans' else np.float32
        columns[name] = getattr(surfels, name).astype(dtype)
    return columns


def covariance_columns(surfels: Surfels) -> Columns:
    """Return cov_xx, cov_xy, ... cov_zz for messages and files, float32; {} without them."""
    if surfels.covariance is None:
        return {}
    return dict(zip(COVARIANCE, surfels.covariance.T.astype(np.float32), strict=True))


def packed_rgb(
    red: npt.NDArray[Any], green: npt.NDArray[Any], blue: npt.NDArray[Any]
) -> npt.NDArray[np.float32]:
    """Return colours packed into float32: bytes 0, red, green, blue from the highest."""
    red, green, blue = (np.rint(channel).astype(np.uint32) for channel in (red, green, blue))
    packed: npt.NDArray[np.float32] = ((red << 16) | (green << 8) | blue).view(np.float32)
    return packed


def file_positions(path: str | Path, surfels: Surfels, origin_m: npt.ArrayLike) -> Columns:
    """
    Return x, y, z of surfels for a file, with the origin of the map added.

    They are float32, which the Point Cloud Library needs, unless that rounds by more than 0.5 mm.
    """
    position = surfels.position + np.asarray(origin_m)
    is_far = np.abs(position).max(initial=0.0) >= FLOAT_REACH_M
    if is_far:
        logger.warning(
            '%s: x, y, z as doubles, since float32 rounds coordinates beyond %g m by more than '
            '0.5 mm; PCL does not read them',
            *(path, FLOAT_REACH_M),
        )
    return dict(zip('xyz', position.T.astype(np.float64 if is_far else np.float32), strict=True))
