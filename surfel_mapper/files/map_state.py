# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Saving and loading a map with its window, exactly: the digests before and after are equal.

The file has the integers of every voxel, and for each scan of the window its moments, stamp, pose,
frame and, if kept, points; so a loaded map continues as if it had never stopped. Files are not
trusted: voxels and counts are checked, and the digest is compared.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import (
    ConfigError,
    FileFormatError,
    MapError,
    NotInMapError,
    refusing,
)
from surfel_mapper.files.state import load_state, save_state
from surfel_mapper.geometry import check_rigid
from surfel_mapper.kernels.layout import MAX_MAP_COUNT
from surfel_mapper.mapping.channels import channel_names
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import WindowedScan

KIND = 'surfel map'

FILE = 'map.npz'
"""Name of the file in the output directory of a replay."""

NAMES = ('key', 'count', 'total', 'product', 'view', 'channels')

SCANS = 'num_scans'
"""Name of the array of numbers of scans, which only the map has."""


def save_map(
    path: str | Path,
    surfel_map: SurfelMap,
    window: Iterable[WindowedScan] = (),
) -> str:
    """
    Write a map, and the scans of its window, to a file; return the digest of the map.

    Parameters
    ----------
    path : str or Path
        The file, usually with the extension npz; written atomically.
    surfel_map : SurfelMap
        The map.
    window : iterable of WindowedScan
        The scans that can be evicted, oldest first: its SlidingWindow.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    digest = surfel_map.digest()
    moments = surfel_map.moments()
    arrays = _arrays('map', moments)
    scans = list(window)
    for number, scan in enumerate(scans):
        arrays |= _arrays(f'scan{number}', scan.moments)
        if scan.points is not None:
            arrays[f'scan{number}.points'] = scan.points
    arrays['scans.stamp_ns'] = np.array([scan.stamp_ns for scan in scans], np.int64)
    arrays['scans.pose'] = np.array([scan.T_map_sensor for scan in scans]).reshape(-1, 4, 4)
    attributes = {
        'kind': KIND,
        'voxel_size_m': surfel_map.voxel_size_m,
        'level': surfel_map.level,
        'columns': surfel_map.columns,
        'origin_m': surfel_map.origin_m.tolist(),
        'frame_ids': [scan.frame_id for scan in scans],
        'digest': digest,
    }
    save_state(path, arrays, attributes)
    return digest


def load_map(
    path: str | Path, *, voxel_size_m: float | None = None
) -> tuple[SurfelMap, list[WindowedScan]]:
    """
    Return a map and the scans of its window, as they were saved.

    Parameters
    ----------
    path : str or Path
        A file that save_map wrote, or the output directory of a replay or of ~/save_map, which
        holds it as map.npz.
    voxel_size_m : float, optional
        The voxel size that is required.

    Returns
    -------
    SurfelMap
        Its digest equals that of the saved map.
    list of WindowedScan
        For SlidingWindow.restore.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is damaged, of another kind or version, or of another voxel
        size.

    """
    if Path(path).is_dir():
        path = Path(path) / FILE
    arrays, attributes = load_state(path)
    if attributes.get('kind') != KIND:
        raise FileFormatError(f'{path}: contains {attributes.get("kind")!r}, expected a {KIND}')
    with refusing(path), map_errors(path):
        surfel_map = empty_map(path, attributes, voxel_size_m)
        surfel_map.insert(_moments(arrays, 'map', surfel_map))
        scans = _scans(arrays, attributes, surfel_map)
        of_window = surfel_map.emptied()
        for scan in scans:
            of_window.insert(scan.moments)
        check_held(surfel_map.moments(), of_window.moments())
    check_digest(path, attributes, surfel_map)
    return surfel_map, scans


def empty_map(
    path: str | Path, attributes: Mapping[str, Any], voxel_size_m: float | None
) -> SurfelMap:
    """Return an empty map with the attributes of a file, which must have a voxel size if given."""
    stated_m = attributes['voxel_size_m']
    if voxel_size_m is not None and stated_m != voxel_size_m:
        raise FileFormatError(
            f'{path}: voxel size {stated_m} m, expected map.voxel_size_m = {voxel_size_m} m'
        )
    return SurfelMap(
        stated_m,
        columns=tuple(attributes['columns']),
        level=attributes['level'],
        origin_m=attributes['origin_m'],
    )


def check_digest(path: str | Path, attributes: Mapping[str, Any], surfel_map: SurfelMap) -> None:
    """Raise FileFormatError if a map has another digest than its file states."""
    digest, stated = surfel_map.digest(), attributes.get('digest')
    if digest != stated:
        raise FileFormatError(f'{path}: damaged: digest {digest}, expected {stated}')


def check_held(whole: ScanMoments, kept: ScanMoments) -> None:
    """
    Raise NotInMapError unless a map holds all points of its window, so that they can be evicted.

    Both are sorted by voxel, as ``SurfelMap.moments`` returns them.
    """
    rows = np.minimum(np.searchsorted(whole.key, kept.key), max(len(whole) - 1, 0))
    is_held = np.zeros(len(kept), np.bool_)
    if len(whole):
        num_others = whole.count[rows] - kept.count
        is_equal = (whole.total[rows] == kept.total).all(axis=1)
        is_equal &= (whole.product[rows] == kept.product).all(axis=1)
        is_equal &= (whole.view[rows] == kept.view).all(axis=1)
        is_held = (whole.key[rows] == kept.key) & ((num_others > 0) | (num_others == 0) & is_equal)
    if not is_held.all():
        voxel = kept.voxel_index[np.argmin(is_held)].tolist()
        raise NotInMapError(f'voxel {voxel} does not hold the points of its window')


def window_stamps_ns(path: str | Path) -> list[int]:
    """
    Return the stamps of the scans of the window in a file that save_map wrote.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is damaged, or of another kind.

    """
    arrays, attributes = load_state(path)
    if attributes.get('kind') != KIND or 'scans.stamp_ns' not in arrays:
        raise FileFormatError(f'{path}: contains {attributes.get("kind")!r}, expected a {KIND}')
    with refusing(path):
        _num_scans(arrays)
    stamps: list[int] = arrays['scans.stamp_ns'].tolist()
    return stamps


@contextmanager
def map_errors(path: str | Path) -> Iterator[None]:
    """Name a file in the errors of the map that is made of its content."""
    try:
        yield
    except (MapError, ConfigError) as error:
        raise FileFormatError(f'{path}: damaged: {error}') from error


def _num_scans(arrays: dict[str, npt.NDArray[Any]]) -> int:
    """Return the number of scans of the window; raise ValueError for wrong stamps or arrays."""
    stamps, poses = arrays['scans.stamp_ns'], arrays['scans.pose']
    if stamps.dtype != np.int64 or stamps.ndim != 1 or (stamps < 0).any():
        raise ValueError(
            f'stamps of scans: {stamps.dtype} {stamps.shape}, expected int64, 0 or up'
        )
    if poses.dtype != np.float64 or poses.shape != (len(stamps), 4, 4):
        raise ValueError(f'poses of scans: {poses.dtype} {poses.shape} for {len(stamps)} scans')
    prefixes = ['map', *(f'scan{number}' for number in range(len(stamps)))]
    expected = {f'{prefix}.{name}' for prefix in prefixes for name in (*NAMES, SCANS, 'points')}
    unknown = sorted({*arrays} - expected - {'scans.stamp_ns', 'scans.pose'})
    if unknown or 'map.points' in arrays:
        raise ValueError(f'unknown arrays {unknown or ["map.points"]}')
    return len(stamps)


def _scans(
    arrays: dict[str, npt.NDArray[Any]], attributes: dict[str, Any], surfel_map: SurfelMap
) -> list[WindowedScan]:
    """Return the scans of the window."""
    num_scans = _num_scans(arrays)
    frame_ids = attributes['frame_ids']
    if not (isinstance(frame_ids, list) and all(isinstance(name, str) for name in frame_ids)):
        raise ValueError(f'frames of scans: {frame_ids!r:.60}, expected a list of names')
    if len(frame_ids) != num_scans:
        raise ValueError(f'{len(frame_ids)} frames for {num_scans} scans')
    return [
        replace(_scan(arrays, number, surfel_map), frame_id=frame_id)
        for number, frame_id in enumerate(frame_ids)
    ]


def _scan(arrays: dict[str, npt.NDArray[Any]], number: int, surfel_map: SurfelMap) -> WindowedScan:
    """Return one scan of the window, without its frame."""
    pose = arrays['scans.pose'][number]
    check_rigid(f'pose of scan {number}', pose)
    points = arrays.get(f'scan{number}.points')
    if points is not None and (
        points.dtype not in (np.float32, np.float64)
        or points.shape[1:] != (3,)
        or not np.isfinite(points).all()
    ):
        raise ValueError(f'points of scan {number}: {points.dtype} {points.shape}, or not finite')
    return WindowedScan(
        moments=_moments(arrays, f'scan{number}', surfel_map),
        stamp_ns=int(arrays['scans.stamp_ns'][number]),
        T_map_sensor=pose,
        points=points,
    )


def names_of(prefix: str) -> tuple[str, ...]:
    """Return the names of the moments under a prefix."""
    return (*NAMES, SCANS) if prefix == 'map' else NAMES


def _arrays(prefix: str, moments: ScanMoments) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of moments by their names in the file."""
    return {f'{prefix}.{name}': getattr(moments, name) for name in names_of(prefix)}


def _moments(
    arrays: dict[str, npt.NDArray[Any]], prefix: str, surfel_map: SurfelMap
) -> ScanMoments:
    """Return the moments under a prefix."""
    columns = {name: arrays[f'{prefix}.{name}'] for name in names_of(prefix)}
    return checked_moments(columns, surfel_map, prefix)


def checked_moments(
    columns: dict[str, npt.NDArray[Any]], surfel_map: SurfelMap, prefix: str
) -> ScanMoments:
    """
    Return moments from a file after checking that they are possible, as the kernels require.

    Parameters
    ----------
    columns : dict of str to array
        The arrays of ScanMoments by name.
    surfel_map : SurfelMap
        The map into which they will be inserted.
    prefix : str
        Name of the moments in errors.

    Raises
    ------
    ValueError
        If shapes or types are wrong, a voxel occurs twice, or its counts and sums are impossible.

    """
    key, count = columns['key'], columns['count']
    names = channel_names(surfel_map.columns)
    widths = {'total': (3,), 'product': (6,), 'view': (3,), 'channels': (len(names),)}
    for name, array in columns.items():
        if array.shape != (len(key), *widths.get(name, ())) or array.dtype.kind != 'i':
            raise ValueError(f'{prefix}.{name}: {array.dtype} {array.shape}')
    wide = [n for n in ('key', 'product', 'channels', SCANS) if n in columns]
    if any(columns[name].dtype != np.int64 for name in wide):
        raise ValueError(f'{prefix}: keys, products, channels or numbers of scans are not int64')
    in_order = key  # as save_map writes them; np.unique, by hashes, takes 80 times as long
    if not (key[1:] > key[:-1]).all():
        in_order = np.sort(key)
    if (in_order[1:] == in_order[:-1]).any() or (key < 0).any():
        raise ValueError(f'{prefix}: a voxel occurs twice, or is out of range')
    if (count < 1).any() or (count > MAX_MAP_COUNT).any():
        raise ValueError(f'{prefix}: impossible numbers of points')
    num_scans = columns.get(SCANS)
    if num_scans is not None and ((num_scans < 1) | (num_scans > count)).any():
        raise ValueError(f'{prefix}: impossible numbers of scans')
    return ScanMoments(
        voxel_size_m=surfel_map.voxel_size_m,
        level=surfel_map.level,
        key=key,
        count=count,
        total=columns['total'],
        product=columns['product'],
        view=columns['view'],
        channel_names=names,
        channels=columns['channels'],
        num_scans=num_scans,
    )
