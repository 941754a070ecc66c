# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ScanMoments: a scan reduced to the exact moments of its voxels; their keys, levels and digest.

Some 10^4 voxels represent 10^5 points, in 78 bytes each (82 with hints of rows). A map adds them,
a window keeps them, and a removal subtracts them again, so the cost of a scan depends on neither
the length of the window nor the size of the map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
import hashlib
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array, check_rows
from surfel_mapper.errors import counted, MapError, MapLimitError
from surfel_mapper.kernels.layout import (
    BITS,
    HALF,
    INDEX_BITS,
    INDEX_MASK,
    INDEX_OFFSET,
    VIEW_SCALE,
)

SLACK = 1.0 + 1e-9
"""For the rounding of products of sums in float64."""

HASHED_ARRAYS = ('key', 'count', 'total', 'product', 'view')
"""The arrays of ScanMoments in the order in which a digest hashes them."""


ARRAYS = (
    ('key', (), (np.int64,)),
    ('count', (), (np.int32, np.int64)),
    ('total', (3,), (np.int32, np.int64)),
    ('product', (6,), (np.int64,)),
    ('view', (3,), (np.int16, np.int64)),
)
"""Name, shape of a row and types of the arrays of ScanMoments."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ScanMoments:
    """
    Exact moments of the points of K voxels; each voxel occurs once.

    Attributes
    ----------
    voxel_size_m : float
        Voxel size of the map.
    level : int
        The lattice unit is ``voxel_size_m / 2^(16 + level)``; 0 for scans.
    key : (K,) int64
        Packed voxel indices.
    count : (K,) int32 or int64
        Number of points of each voxel.
    total : (K, 3) int32 or int64
        Sum of the positions q of the points, in lattice units about the voxel centre.
    product : (K, 6) int64
        Sum of q q^T, order xx xy xz yy yz zz.
    view : (K, 3) int16 or int64
        int16: 2^14 times the unit vector to the sensor, equal for all points of the voxel;
        int64: its sum over the points.
    channel_names : tuple of str
        Names of the summed channels: intensity, red, green, blue.
    channels : (K, C) int64
        Sums of the channels over the points; units in mapping/channels.py.
    left_out : mapping of str to int
        Number of points left out by cause: not_finite, too_near, too_far, beyond_map.
    num_scans : (K,) int64, optional
        Number of scans of which these are the sums, of each voxel. None: one scan.
    rows : (K,) int32, optional
        Rows of the voxels in the map that inserted these moments last. Only hints, which save
        the look-up at removal: a map confirms each by the key in the row.
    num_reduced : int, optional
        Number of points of which a Reducer made these moments, so that a map need not test if
        points can have them. None for others, copies with other values too.

    Examples
    --------
    >>> from surfel_mapper import SurfelMap
    >>> moments = SurfelMap(0.5).add([[0.1, 0.1, 0.1], [0.2, 0.2, 0.1], [0.7, 0.1, 0.1]])
    >>> moments
    ScanMoments(3 points in 2 voxels of 0.5 m)

    """

    voxel_size_m: float
    level: int = 0
    key: npt.NDArray[np.int64]
    count: npt.NDArray[Any]
    total: npt.NDArray[Any]
    product: npt.NDArray[np.int64]
    view: npt.NDArray[Any]
    channel_names: tuple[str, ...] = ()
    channels: npt.NDArray[np.int64] = None  # type: ignore[assignment]  # none: (K, 0)
    left_out: Mapping[str, int] = field(default_factory=dict)
    num_scans: npt.NDArray[np.int64] | None = None
    rows: npt.NDArray[np.int32] | None = field(default=None, init=False, repr=False)
    num_reduced: int | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        """Set missing channels to zero; a map tests the arrays when it takes them."""
        if not isinstance(self.key, np.ndarray):
            raise ValueError(f'key: a {type(self.key).__name__}, expected an array (K,)')
        if self.channels is None:
            object.__setattr__(self, 'channels', np.empty((len(self.key), 0), np.int64))

    def __repr__(self) -> str:
        """Return the numbers of points and voxels."""
        size = f'{self.voxel_size_m:g} m'
        points, voxels = counted(self.num_points, 'point'), counted(len(self), 'voxel')
        return f'ScanMoments({points} in {voxels} of {size})'

    def __len__(self) -> int:
        """Return the number of voxels."""
        return len(self.key)

    @property
    def num_voxels(self) -> int:
        """Number of voxels."""
        return len(self.key)

    @property
    def num_points(self) -> int:
        """Number of points."""
        if self.num_reduced is not None:
            return self.num_reduced
        return int(self.count.sum(dtype=np.int64))

    @property
    def voxel_index(self) -> npt.NDArray[np.int32]:
        """Voxel indices, (K, 3) int32."""
        return unpack_keys(self.key)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays, without the hints."""
        num_bytes = self.key.nbytes + self.count.nbytes + self.total.nbytes
        num_bytes += self.product.nbytes + self.view.nbytes
        num_scans = 0 if self.num_scans is None else self.num_scans.nbytes
        return num_bytes + self.channels.nbytes + num_scans

    @property
    def scans(self) -> npt.NDArray[np.int64]:
        """Number of scans of each voxel, (K,): ``num_scans``, or 1."""
        return np.ones(len(self), np.int64) if self.num_scans is None else self.num_scans

    @property
    def arrays(self) -> tuple[npt.NDArray[Any], ...]:
        """The arrays as the kernels take them: key, count, total, product, view."""
        return self.key, self.count, self.total, self.product, self.view

    @property
    def view_is_sum(self) -> int:
        """1 if the view is a sum over points, 0 if it is the view of a single point."""
        return int(self.view.dtype == np.int64)

    def select(self, voxels: slice | npt.NDArray[Any]) -> ScanMoments:
        """Return the moments of selected voxels: a slice, a mask (K,) bool or row indices."""
        check_rows('voxels', voxels)
        names = (*HASHED_ARRAYS, 'channels', *([] if self.num_scans is None else ['num_scans']))
        return replace(self, **{name: getattr(self, name)[voxels] for name in names})


def point_keys(
    points: npt.NDArray[Any], T_map_sensor: npt.NDArray[np.float64], voxel_size_m: float
) -> npt.NDArray[np.int64]:
    """Return the voxel key of each point, (N,) int64; -1 if it is outside of the grid."""
    x, y, z = points.astype(np.float64).T
    scale = (1 << BITS) / voxel_size_m
    with np.errstate(invalid='ignore'):  # nan and inf are outside of the grid
        lattice = [
            np.floor((((r[0] * x + r[1] * y) + r[2] * z) + r[3]) * scale) for r in T_map_sensor[:3]
        ]
        inside = np.all([np.abs(a) < INDEX_OFFSET << BITS for a in lattice], axis=0)
    keys = np.full(len(points), -1)
    index = [a[inside].astype(np.int64) >> BITS for a in lattice]
    keys[inside] = pack_keys(np.stack(index, axis=1))
    return keys


def whole_keys(key: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return voxel keys (K,) as the kernels take them; TypeError for other arrays."""
    keys = as_array('keys', key)
    if keys.ndim != 1 or (keys.size and keys.dtype.kind not in 'iu'):
        raise TypeError(f'keys: {keys.dtype} {keys.shape}, expected int64 (K,)')
    return np.ascontiguousarray(keys, np.int64)


def pack_keys(voxel_index: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return the keys (K,) int64 of voxel indices (K, 3), each in [-2^20, 2^20)."""
    shifted = voxel_index.astype(np.int64) + INDEX_OFFSET
    packed = (shifted[:, 0] << (2 * INDEX_BITS)) | (shifted[:, 1] << INDEX_BITS) | shifted[:, 2]
    return np.asarray(packed, np.int64)


def within_reach(voxel_index: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Return which voxel indices (K, 3), of any integer type, have a key: those of 21 bits."""
    inside = (voxel_index >= -INDEX_OFFSET) & (voxel_index < INDEX_OFFSET)
    return np.asarray(inside.all(axis=1))


def unpack_keys(key: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
    """Return the voxel indices (K, 3) int32 of keys (K,) int64."""
    index = np.empty((len(key), 3), np.int32)
    for axis in range(3):  # one at a time: a quarter of the time of all at once
        index[:, axis] = (key >> ((2 - axis) * INDEX_BITS)) & INDEX_MASK
    index -= INDEX_OFFSET
    return index


OTHER_UNIT = (
    'these points lie hundreds of metres apart, almost each in a voxel of its own: are they '
    'millimetres or centimetres? Metres are expected; multiply them by 0.001 or 0.01'
)
"""The warning about points that look like another unit than metres."""

MANY, ALONE, CELL_M, FAR_M = 100, 0.9, 0.5, 150.0
"""
Points look like another unit if there are at least this number of them, as many cells as this
share of them, of this edge, m, and a median distance from their middle of more than this, m: a
lidar that reaches 200 m measures most points within 50 m, a room in centimetres has some 400.
"""


def looks_like_other_unit(moments: ScanMoments) -> bool:
    """Return whether the points of a scan are so far apart that they may be no metres."""
    if not len(moments) >= max(MANY, ALONE * moments.num_points):
        return False
    position = moments.voxel_index.astype(np.float64) * moments.voxel_size_m
    return are_far_apart(position, moments.num_points)


def are_far_apart(position: npt.NDArray[Any], num_points: int) -> bool:
    """Return whether positions (K, 3) of points are so far apart that these may be no metres."""
    if not len(position) >= max(MANY, ALONE * num_points):
        return False
    apart_m = np.linalg.norm(position - np.median(position, axis=0), axis=1)
    if not np.median(apart_m) > FAR_M:
        return False
    return len(np.unique(np.floor(position / CELL_M), axis=0)) >= ALONE * num_points


def shifted_moments(moments: ScanMoments, voxels: npt.NDArray[np.int64]) -> ScanMoments:
    """
    Return the same moments in voxels whose indices are larger by an offset (3,).

    Raises
    ------
    MapLimitError
        If a voxel would be beyond the range of the indices.

    """
    index = moments.voxel_index + voxels
    if len(index) and not (index.min() >= -INDEX_OFFSET and index.max() < INDEX_OFFSET):
        raise MapLimitError(
            f'voxel indices {index.min()} to {index.max()} after a shift by {voxels.tolist()}, '
            f'expected {-INDEX_OFFSET} to {INDEX_OFFSET - 1}; use larger voxels'
        )
    return replace(moments, key=pack_keys(index))


def check_arrays(moments: ScanMoments) -> None:
    """Raise MapError unless the arrays have the shapes and types that the kernels read."""
    channels = len(moments.channel_names)
    optional_arrays = ('channels', (channels,), (np.int64,)), ('scans', (), (np.int64,))
    for name, width, types in (*ARRAYS, *optional_arrays):
        array = getattr(moments, name)
        shape = (len(moments), *width)
        if not (isinstance(array, np.ndarray) and array.shape == shape and array.dtype in types):
            actual = f'{getattr(array, "dtype", type(array).__name__)} {np.shape(array)}'
            expected = ' or '.join(dtype.__name__ for dtype in types)
            raise MapError(f'{name} of the moments: {actual}, expected {expected} {shape}')


def check_possible(moments: ScanMoments) -> None:
    """Raise MapError if a voxel occurs twice, or no points of it can have its moments."""
    if not (moments.key[1:] > moments.key[:-1]).all():  # as the moments of a map are sorted
        in_order = np.sort(moments.key)
        if (in_order[1:] == in_order[:-1]).any():
            raise MapError('a voxel occurs twice in the moments')
    is_impossible = impossible(moments)
    if is_impossible.any():
        row = int(np.argmax(is_impossible))
        raise MapError(
            f'row {row} of the moments: key {moments.key[row]}, {moments.count[row]} points, '
            f'sums {moments.total[row].tolist()}, products {moments.product[row].tolist()}, '
            f'views {moments.view[row].tolist()}, {moments.scans[row]} scans; expected those of '
            'points in a voxel'
        )


def impossible(moments: ScanMoments) -> npt.NDArray[np.bool_]:
    """
    Return which rows, (K,), hold moments that no points of a voxel can have.

    Tested: keys that are not negative, counts of 1 or more, sums within the voxel, second moments
    that satisfy the inequality of Cauchy and Schwarz, views no longer than their unit, 1 to count
    scans. Others would overflow the integers of the map or give negative eigenvalues later, far
    from the cause.
    """
    half = float(HALF << moments.level)
    count = moments.count.astype(np.float64)[:, None]
    total, view = moments.total.astype(np.float64), moments.view.astype(np.float64)
    square = moments.product[:, [0, 3, 5]].astype(np.float64)  # xx yy zz
    farthest = VIEW_SCALE * (count if moments.view_is_sum else 1.0) + 1.0
    beyond = (
        (np.abs(total) > count * half)
        | (square > count * half * half * SLACK)
        | (total * total > count * square * SLACK)
        | (np.abs(view) > farthest)
    )
    beyond_scans = (moments.scans < 1) | (moments.scans > moments.count)
    return np.asarray((moments.key < 0) | (moments.count < 1) | beyond.any(axis=1) | beyond_scans)


def digest_of(
    voxel_size_m: float,
    level: int,
    num_voxels: int,
    columns: tuple[str, ...],
    chunks: Callable[[str], Iterable[npt.NDArray[Any]]],
) -> str:
    """
    Return the SHA-256 of the state of a map in hexadecimal.

    The arrays are hashed one after the other and in chunks. A map larger than the memory can be
    hashed too.

    Parameters
    ----------
    voxel_size_m : float
        Edge of a voxel, m.
    level : int
        See SurfelMap.
    num_voxels : int
        Voxels of the whole map.
    columns : tuple of str
        Columns of the points that the map sums.
    chunks : callable
        Yields the array of a name of HASHED_ARRAYS, or of ``channels``, in any number of chunks:
        a row for each voxel, sorted by key.

    Notes
    -----
    Hashed are: the text ``surfel map 1``, the voxel size as float64, level and number of voxels;
    the keys, counts, sums (x y z), products (xx xy xz yy yz zz) and view sums (x y z) of all
    voxels, array by array and sorted by key; if the map has columns, their comma-separated names
    and the channel sums. All numbers but the voxel size are int64, all are little-endian. The
    key of voxel (i, j, k) is ((i + 2^20) 2^21 + (j + 2^20)) 2^21 + (k + 2^20).

    """
    state = hashlib.sha256(b'surfel map 1')
    state.update(struct.pack('<dqq', voxel_size_m, level, num_voxels))
    for name in HASHED_ARRAYS:
        for chunk in chunks(name):
            state.update(np.ascontiguousarray(chunk, dtype='<i8').data)
    if columns:
        state.update(','.join(columns).encode())
        for chunk in chunks('channels'):
            state.update(np.ascontiguousarray(chunk, dtype='<i8').data)
    return state.hexdigest()
