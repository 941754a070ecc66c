# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes, surfaces and Gaussians as bytes: a header, then columns of integers, compressed by zlib.

docs/models_format.md states the layout. Lengths are integers, in steps of 1/128 of a voxel, so a
coordinate moves by half a step at most; rotations are quaternions in 1/32767; covariances are
their Cholesky factors, so that they stay positive. Packing models that were unpacked gives the
same bytes.

Bytes that come from elsewhere are checked before they are used, and memory is asked for before it
is allocated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
import math
from pathlib import Path
import struct
from typing import Any
import zlib

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import Budget
from surfel_mapper.errors import FileFormatError, ModelError
from surfel_mapper.models.bspline import HeightField
from surfel_mapper.models.grid import Grid
from surfel_mapper.models.primitives import Gaussians, Plane, Surface

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

MAGIC, VERSION = b'SMMODELS', 1

FIXED = struct.Struct('<8sHHIIIIIIIqddddQH')
"""Magic, version, flags, CRC-32 of all bytes from COVERED on, number of the message, planes,
surfaces, Gaussians, removed ids, bytes of the columns, stamp, edge of a voxel, step, noise (2),
thinned points, bytes of the frame's name."""

COVERED = 16

COMPLETE = 1
"""Flag: all primitives, not changes."""

STEPS = 128
"""Steps a voxel: 0.3 mm for voxels of 4 cm, a tenth of the noise of a depth camera."""

CONTROL = 8
"""Heights of control points are multiples of this: 1/16 voxel, which saves a quarter of them."""

TURNS = 32767
"""Steps of a component of a quaternion: 0.15 mm at 5 m."""

CUT = 1
"""Cuts are multiples of this, 1/15 of the pitch: 4 bits instead of 8."""

MOST_STEPS = 2**53
"""Lengths have fewer steps; float64 holds these integers."""

MOST_DEGREE = 5

LOWER = np.tril_indices(3)

PATCH_MEMORY, CELL_MEMORY, CONTROL_MEMORY = 2048, 16, 24
"""Memory of a patch, of a cell and of a control point when unpacked, bytes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelsHeader:
    """
    Facts about all primitives.

    Attributes
    ----------
    voxel_size_m : float
        Edge of the voxels for thinning.
    noise : (float, float)
        See MultiModel.
    num_thinned : int
        Points of the thinned cloud.
    number : int
        Of a message; 0 in a file.
    is_complete : bool
        Whether all primitives are packed, or only those that changed since the previous message.
    stamp_ns : int
        Stamp of the newest scan; 0 if there is none.
    frame_id : str
        Frame of the map; empty if it has no name.

    """

    voxel_size_m: float
    noise: tuple[float, float] = (0.0, 0.0)
    num_thinned: int = 0
    number: int = 0
    is_complete: bool = True
    stamp_ns: int = 0
    frame_id: str = ''


@dataclass(frozen=True, slots=True, eq=False)
class Unpacked:
    """
    Primitives and their header.

    Attributes
    ----------
    header : ModelsHeader
    planes : list of Plane
    surfaces : list of Surface
    gaussians : Gaussians
    versions : dict of int to int
        Versions of the primitives by id; 1 if they have not changed.
    removed : tuple of int
        Ids that are gone since the previous message.

    """

    header: ModelsHeader
    planes: list[Plane]
    surfaces: list[Surface]
    gaussians: Gaussians
    versions: dict[int, int]
    removed: tuple[int, ...]


def pack(
    header: ModelsHeader,
    patches: tuple[Sequence[Plane], Sequence[Surface]],
    gaussians: Gaussians,
    versions: Mapping[int, int] | None = None,
    removed: Sequence[int] = (),
) -> bytes:
    """
    Return primitives as bytes.

    Parameters
    ----------
    header : ModelsHeader
        Facts about all of them.
    patches : (sequence of Plane, sequence of Surface)
        Planes, and surfaces.
    gaussians : Gaussians
        Gaussians.
    versions : mapping of int to int, optional
        Versions of the primitives by id; 1 if omitted.
    removed : sequence of int
        Ids that are gone since the previous message.

    Raises
    ------
    ModelError
        If a number is not finite, or too large for its column.

    """
    planes, surfaces = patches
    step_m, every = header.voxel_size_m / STEPS, [*planes, *surfaces]
    ids = np.concatenate([np.array([p.id for p in every], np.int64), gaussians.id])
    own = [1] * len(ids) if versions is None else [versions[number] for number in ids.tolist()]
    columns = b''.join(
        [
            column(ids, '<u4'),
            column(np.array(own, np.int64), '<u4'),
            *moments_columns(every, gaussians, step_m),
            *patch_columns(every, step_m),
            *surface_columns(surfaces, step_m),
            column(np.array(removed, np.int64), '<u4'),
        ]
    )
    name = header.frame_id.encode()
    counts = len(planes), len(surfaces), len(gaussians), len(removed), len(columns)
    facts = header.stamp_ns, header.voxel_size_m, step_m, *header.noise, header.num_thinned
    flags = COMPLETE if header.is_complete else 0
    fixed = (header.number, *counts, *facts, len(name))
    body = name + zlib.compress(columns, 9)
    covered = FIXED.pack(MAGIC, VERSION, flags, 0, *fixed)[COVERED:] + body
    return FIXED.pack(MAGIC, VERSION, flags, zlib.crc32(covered), *fixed) + body


def column(values: npt.NDArray[Any], dtype: str) -> bytes:
    """
    Return integers as the lowest bytes of all, then the next ones; they compress to a half.

    Raises
    ------
    ModelError
        If one does not fit.

    """
    packed = np.ascontiguousarray(values.ravel(), dtype)
    if not np.array_equal(packed, values.ravel()):
        raise ModelError(f'ids, versions or numbers of cells beyond {np.iinfo(dtype).max}')
    return packed.view(np.uint8).reshape(-1, packed.itemsize).T.tobytes()


def signed(values: Array, step_m: float) -> bytes:
    """
    Return lengths (N, C) as C columns of steps, without sign: 0, -1, 1, -2 are 0, 1, 2, 3.

    Raises
    ------
    ModelError
        If one is not finite or has too many steps.

    """
    return b''.join(column(zigzag(row), '<u8') for row in steps_of(values, step_m).T)


def steps_of(values: Array, step_m: float) -> Indices:
    """Return lengths as the nearest numbers of steps."""
    scaled = np.rint(values / step_m)
    if not (np.abs(scaled) < MOST_STEPS).all():
        far = values[~(np.abs(scaled) < MOST_STEPS)][0]
        raise ModelError(f'{far:g} m, expected less than {MOST_STEPS * step_m:g} m')
    return scaled.astype(np.int64)


def zigzag(values: Indices) -> npt.NDArray[np.uint64]:
    """Return integers as small ones without sign."""
    return ((values << 1) ^ (values >> 63)).astype(np.uint64)


def moments_columns(patches: Sequence[Plane], gaussians: Gaussians, step_m: float) -> list[bytes]:
    """Return numbers of points, means and factors of covariances of all primitives."""
    numbers = np.array([patch.num_points for patch in patches], np.int64)
    means = np.array([patch.mean for patch in patches]).reshape(-1, 3)
    turned = [p.R_patch_map @ p.covariance @ p.R_patch_map.T for p in patches]
    covariances = np.concatenate([np.array(turned).reshape(-1, 3, 3), gaussians.covariance])
    return [
        column(np.concatenate([numbers, gaussians.num_points]), '<u8'),
        signed(np.concatenate([means, gaussians.mean]), step_m),
        signed(factors(covariances, step_m), step_m),
    ]


def factors(covariances: Array, least_m: float) -> Array:
    """
    Return the Cholesky factors (N, 6) of covariances (N, 3, 3): rows of the lower triangle.

    The first two elements of the diagonal are at least ``least_m``; of a singular covariance
    there would be several factors otherwise.
    """
    c = covariances
    l00 = np.maximum(np.sqrt(np.maximum(c[:, 0, 0], 0.0)), least_m)
    l10, l20 = c[:, 1, 0] / l00, c[:, 2, 0] / l00
    l11 = np.maximum(np.sqrt(np.maximum(c[:, 1, 1] - l10**2, 0.0)), least_m)
    l21 = (c[:, 2, 1] - l20 * l10) / l11
    l22 = np.sqrt(np.maximum(c[:, 2, 2] - l20**2 - l21**2, 0.0))
    return np.stack([l00, l10, l11, l20, l21, l22], axis=1)


def patch_columns(patches: Sequence[Plane], step_m: float) -> list[bytes]:
    """Return frames and outlines of planes and surfaces."""
    grids = [patch.grid for patch in patches]
    pairs = [(grid, grid.rim) for grid in grids]
    none: npt.NDArray[Any] = np.empty((0, 3), np.uint8)
    corner = np.concatenate([none[:, 0], *(grid.corner[rim] for grid, rim in pairs)])
    cuts = needed_cuts(np.concatenate([none, *(grid.cuts[rim] for grid, rim in pairs)]))
    corner[~cuts.any(axis=1)] = 0
    return [
        *(column(row, '<i2') for row in turns(patches).T),
        signed(np.array([[patch.rms_m] for patch in patches]).reshape(-1, 1), step_m),
        np.array([grid.pitch_m for grid in grids]).view(np.uint8).reshape(-1, 8).T.tobytes(),
        signed(np.array([grid.origin for grid in grids]).reshape(-1, 2), step_m),
        *(column(np.array([g.filled.shape[k] for g in grids], np.int64), '<u4') for k in (0, 1)),
        np.packbits(np.concatenate([[], *(g.filled.ravel() for g in grids)]) > 0.0).tobytes(),
        corner.tobytes(),
        cuts.T.tobytes(),
    ]


def turns(patches: Sequence[Plane]) -> Indices:
    """Return the rotations of patches as quaternions (K, 4) of steps, the first positive."""
    if not patches:
        return np.empty((0, 4), np.int64)
    from scipy.spatial.transform import Rotation  # 0.4 s that mapping without models saves

    q_xyzw = Rotation.from_matrix([patch.R_patch_map for patch in patches]).as_quat()
    steps = np.rint(TURNS * q_xyzw)
    for _ in range(8):  # until the steps are those of the quaternion that they stand for
        steps = np.rint(TURNS * steps / np.linalg.norm(steps, axis=1, keepdims=True))
    first = np.take_along_axis(steps, (steps != 0.0).argmax(axis=1)[:, None], axis=1)
    rounded: Indices = (steps * np.sign(first)).astype(np.int64)
    return rounded


def needed_cuts(cuts: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return cuts (R, 3) without triangles that lie in the strips."""
    x, y, triangle = cuts.astype(np.int64).T
    needed = cuts.copy()
    needed[2 * triangle <= x + y, 2] = 0
    return needed


def surface_columns(surfaces: Sequence[Surface], step_m: float) -> list[bytes]:
    """Return the splines of surfaces; control points as differences along y, then x."""
    splines = [surface.spline for surface in surfaces]
    changes = []
    for spline in splines:
        control = CONTROL * steps_of(spline.control, CONTROL * step_m)
        change = np.diff(control, axis=1, prepend=0)
        change[:, 0] = np.diff(control[:, 0], prepend=0)
        changes.append(zigzag(change.ravel()))
    sizes = np.array([spline.control.shape for spline in splines], np.int64).reshape(-1, 2)
    degrees = np.array([spline.degrees for spline in splines], np.int64).reshape(-1, 2)
    return [
        *(column(row, '<u1') for row in degrees.T),
        np.array([spline.pitch_m for spline in splines]).view(np.uint8).reshape(-1, 8).T.tobytes(),
        signed(np.array([spline.origin for spline in splines]).reshape(-1, 2), step_m),
        *(column(row, '<u4') for row in sizes.T),
        column(np.concatenate(changes) if changes else np.empty(0, np.uint64), '<u8'),
    ]


def unpack(data: bytes, name: str | Path) -> Unpacked:
    """
    Return the primitives in bytes.

    Parameters
    ----------
    data : bytes
        Of ``pack``.
    name : str or Path
        File or topic, for errors.

    Raises
    ------
    FileFormatError
        If they are no models, damaged, of another version, or need more memory than inputs of
        their size may (see Budget).

    """
    if len(data) < FIXED.size or not data.startswith(MAGIC):
        raise FileFormatError(f'{name}: expected models, which begin with {MAGIC.decode()}')
    _, version, flags, crc, *fixed = FIXED.unpack_from(data)
    if version != VERSION or flags & ~COMPLETE:
        raise FileFormatError(
            f'{name}: models of version {version}, flags {flags}; this release reads version '
            f'{VERSION}'
        )
    if zlib.crc32(memoryview(data)[COVERED:]) != crc:
        raise FileFormatError(f'{name}: damaged, its CRC is not {crc:08x}')
    number, *counts, size, stamp_ns, voxel_size_m, step_m, n0, n2, num_thinned, letters = fixed
    start = FIXED.size + letters
    try:
        frame_id = data[FIXED.size : start].decode()
    except UnicodeDecodeError as error:
        raise FileFormatError(f'{name}: name of the frame: {error}') from error
    header = ModelsHeader(
        voxel_size_m=voxel_size_m,
        noise=(n0, n2),
        num_thinned=num_thinned,
        number=number,
        is_complete=bool(flags & COMPLETE),
        stamp_ns=stamp_ns,
        frame_id=frame_id,
    )
    budget = Budget(name, len(data), FileFormatError)
    columns = Columns(name, inflated(data[start:], size, budget), step_m, budget)
    columns.check(0.0 < step_m <= voxel_size_m < 1e9, f'voxels of {voxel_size_m} m')
    columns.check(0.0 <= n0 < math.inf and 0.0 <= n2 < math.inf, f'noise {n0}, {n2}')
    return columns.primitives(header, *counts)


def inflated(body: bytes, size: int, budget: Budget) -> bytes:
    """Return the columns, of a size that the header states."""
    budget.take(3 * size, f'columns of {size} bytes')
    reader = zlib.decompressobj()
    try:
        raw = reader.decompress(body, size + 1)
    except zlib.error as error:
        raise FileFormatError(f'{budget.name}: {error}') from error
    if len(raw) != size or not reader.eof or reader.unused_data:
        raise FileFormatError(f'{budget.name}: expected columns of {size} bytes, and no more')
    return raw


class Columns:
    """Reads columns one after the other, and checks them."""

    def __init__(self, name: str | Path, raw: bytes, step_m: float, budget: Budget) -> None:
        self._name = name
        self._raw = raw
        self._step_m = step_m
        self._budget = budget
        self._at = 0

    def check(self, is_right: bool | np.bool_, text: str) -> None:
        """Raise an error unless a condition holds."""
        if not is_right:
            raise FileFormatError(f'{self._name}: not possible in models: {text}')

    def take(self, number: int, dtype: str) -> npt.NDArray[Any]:
        """Return the next column of ``number`` values."""
        size = np.dtype(dtype).itemsize
        rows = np.frombuffer(self._bytes(number * size), np.uint8).reshape(size, number)
        return np.ascontiguousarray(rows.T).reshape(-1).view(dtype)

    def _bytes(self, number: int) -> bytes:
        start, self._at = self._at, self._at + number
        self.check(self._at <= len(self._raw), f'{len(self._raw)} bytes, {self._at} expected')
        return self._raw[start : self._at]

    def integers(self, number: int) -> Indices:
        """Return the next column of integers with a sign, (number,)."""
        values = self.take(number, '<u8')
        self.check((values < 2 * MOST_STEPS).all(), f'lengths of {MOST_STEPS} steps')
        halves = (values >> np.uint64(1)).astype(np.int64)
        return halves ^ -(values & np.uint64(1)).astype(np.int64)

    def lengths(self, number: int, width: int) -> Array:
        """Return the next ``width`` columns of lengths, (number, width), m."""
        columns = [self.integers(number) for _ in range(width)]
        lengths: Array = np.stack(columns, axis=1).astype(np.float64) * self._step_m
        return lengths

    def pitches(self, number: int) -> list[float]:
        """Return the next column of edges of cells, m."""
        values = self.take(number, '<f8')
        self.check(((values > 0.0) & (values < math.inf)).all(), 'cells without size')
        return [float(value) for value in values]

    def primitives(
        self, header: ModelsHeader, planes: int, surfaces: int, gaussians: int, removed: int
    ) -> Unpacked:
        """Return all primitives."""
        patches, total = planes + surfaces, planes + surfaces + gaussians
        ids = self.take(total, '<u4').astype(np.int64)
        self.check(len(np.unique(ids)) == total, 'an id twice')
        versions = self.take(total, '<u4').tolist()
        numbers = self.take(total, '<u8')
        self.check((numbers < MOST_STEPS).all(), f'{MOST_STEPS} points')
        means, roots = self.lengths(total, 3), np.zeros((total, 3, 3))
        roots[:, LOWER[0], LOWER[1]] = self.lengths(total, 6)
        covariances: Array = roots @ roots.swapaxes(1, 2)
        frames, rms_m = self._frames(patches), self.lengths(patches, 1)[:, 0].tolist()
        covariances[:patches] = frames.swapaxes(1, 2) @ covariances[:patches] @ frames
        number = numbers.astype(np.int64)
        grids = self._grids(patches)
        flat = [
            Plane(
                id=int(ids[k]),
                num_points=int(number[k]),
                mean=means[k],
                covariance=covariances[k],
                R_patch_map=frames[k],
                rms_m=rms_m[k],
                grid=grids[k],
            )
            for k in range(patches)
        ]
        splines = self._splines(surfaces)
        gone = tuple(self.take(removed, '<u4').tolist())
        self.check(self._at == len(self._raw), f'{len(self._raw) - self._at} bytes too many')
        return Unpacked(
            header=header,
            planes=flat[:planes],
            surfaces=[
                plane.bent(spline, plane.rms_m)
                for plane, spline in zip(flat[planes:], splines, strict=True)
            ],
            gaussians=Gaussians(
                ids[patches:], number[patches:], means[patches:], covariances[patches:]
            ),
            versions=dict(zip(ids.tolist(), versions, strict=True)),
            removed=gone,
        )

    def _frames(self, number: int) -> Array:
        """Return the next rotations, (number, 3, 3)."""
        steps = np.stack([self.take(number, '<i2') for _ in range(4)], axis=1)
        self.check(steps.any(axis=1).all(), 'a rotation of 0')
        if not number:  # older versions of scipy refuse empty arrays
            return np.empty((0, 3, 3))
        from scipy.spatial.transform import Rotation  # 0.4 s that mapping without models saves

        frames: Array = Rotation.from_quat(steps.astype(np.float64)).as_matrix()
        return frames

    def _sizes(self, number: int, least: int, memory: int) -> list[tuple[int, int]]:
        """Return the next numbers of cells along x and y; ask for their memory."""
        x, y = (self.take(number, '<u4').tolist() for _ in range(2))
        sizes = list(zip(x, y, strict=True))
        self.check(all(min(size) >= least for size in sizes), f'fewer than {least} cells')
        total = sum(x * y for x, y in sizes)
        self._budget.take(total * memory + number * PATCH_MEMORY, f'{total} cells')
        return sizes

    def _grids(self, number: int) -> list[Grid]:
        """Return the next outlines."""
        pitches, origins = self.pitches(number), self.lengths(number, 2)
        sizes = self._sizes(number, 1, CELL_MEMORY)
        total = sum(x * y for x, y in sizes)
        bits = np.frombuffer(self._bytes(-(-total // 8)), np.uint8)
        filled, start = np.unpackbits(bits, count=total).view(np.bool_), 0
        grids = []
        for pitch_m, origin, (x, y) in zip(pitches, origins, sizes, strict=True):
            own = filled[start : start + x * y].reshape(x, y).copy()
            uncut = np.zeros((x, y), np.uint8), np.zeros((x, y, 3), np.uint8)
            grids.append(Grid(pitch_m, origin, own, *uncut))
            start += x * y
        rims = [grid.rim for grid in grids]
        ends = np.cumsum([0, *(np.count_nonzero(rim) for rim in rims)]).tolist()
        corner = np.frombuffer(self._bytes(ends[-1]), np.uint8)
        self.check((corner < 4).all(), 'a corner beyond 3')
        cuts = np.frombuffer(self._bytes(3 * ends[-1]), np.uint8).reshape(3, -1).T
        for grid, rim, (begin, end) in zip(grids, rims, pairwise(ends), strict=True):
            grid.corner[rim], grid.cuts[rim] = corner[begin:end], cuts[begin:end]
        return grids

    def _splines(self, number: int) -> list[HeightField]:
        """Return the next splines."""
        x, y = (self.take(number, '<u1').tolist() for _ in range(2))
        degrees = list(zip(x, y, strict=True))
        pitches, origins = self.pitches(number), self.lengths(number, 2)
        sizes = self._sizes(number, 3, CONTROL_MEMORY)
        for size, degree in zip(sizes, degrees, strict=True):
            fits = degree[0] < size[0] and degree[1] < size[1] and min(degree) >= 1
            self.check(fits and max(degree) <= MOST_DEGREE, f'degrees {degree}')
        values, start = self.integers(sum(x * y for x, y in sizes)), 0
        splines = []
        for k, (x, y) in enumerate(sizes):
            change = values[start : start + x * y].reshape(x, y).copy()
            change[:, 0] = change[:, 0].cumsum()
            control = change.cumsum(axis=1) * self._step_m
            splines.append(HeightField(pitches[k], origins[k], degrees[k], control))
            start += x * y
        return splines
