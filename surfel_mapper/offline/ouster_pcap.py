# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Scans of an Ouster lidar in a capture of its packets, with its metadata beside it, by ouster-sdk.

The profiles of packets differ between firmwares, and ouster-sdk knows all of them. Two of its
interfaces are read: that of 0.12, the last release that does not pin an old rosbags, which the
extra installs, and that of 1.0, see INSTALL.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
from importlib import metadata
import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import DependencyError, FileFormatError
from surfel_mapper.files.trajectory import Trajectory

SUFFIX = '.pcap'

INSTALL = (
    "pip install 'surfel_mapper[ouster]'` (Python 3.10 to 3.12), or `pip install more-itertools "
    "&& pip install --no-deps 'ouster-sdk>=1,<2'"
)

INTENSITIES = ('SIGNAL', 'REFLECTIVITY')
"""Fields that are the intensity; profiles of low data rate have the second alone."""


class OusterPcap:
    """
    The scans of a capture of one Ouster lidar.

    Parameters
    ----------
    path : Path
        The capture; a file of metadata (JSON) whose name begins alike is beside it.

    Attributes
    ----------
    files : list of Path
        The capture, once for each scan.
    stamps_ns : list of int
        Arrival of the first packet of each scan.

    Raises
    ------
    DependencyError
        If ouster-sdk is not installed.
    FileFormatError
        If it is no capture, has no metadata, no scan, or several lidars.

    Notes
    -----
    ouster-sdk 1.0 ends the process at a UDP packet without content, which no lidar sends.

    """

    format = 'packets of an Ouster lidar'
    trajectory: Trajectory | None = None
    poses_path: Path | None = None

    def __init__(self, path: Path) -> None:
        read = reader_of_sdk(path)
        try:
            self._frames = read(str(path))
        except Exception as error:  # the package states no types of its errors
            raise FileFormatError(
                f'{path}: {error}; expected packets of an Ouster lidar, and its metadata (JSON) '
                'of the same name beside it'
            ) from error
        self.stamps_ns = self._frames.stamps_ns
        if self._frames.num_lidars != 1 or not self.stamps_ns:
            raise FileFormatError(
                f'{path}: {len(self.stamps_ns)} scans of {self._frames.num_lidars} lidars, '
                'expected scans of one'
            )
        self.files = [path] * len(self.stamps_ns)

    def scan(self, number: int) -> tuple[npt.NDArray[np.float32], dict[str, npt.NDArray[Any]]]:
        """
        Return the points (N, 3), m, of a scan in the frame of the sensor, and their columns.

        ``t`` is the time in ns since the first column, by the clock of the lidar; ``ring`` the
        beam from the top. Of two returns the first is taken; pixels without a return are left out.

        Raises
        ------
        FileFormatError
            If the packets of the scan cannot be decoded, or none of them arrived.

        """
        try:
            frame = self._frames.frame(number)
            points = np.asarray(self._frames.to_points(frame)).reshape(-1, 3)
            fields = {name: frame.field(name).ravel() for name in frame.fields}
            is_valid = (np.asarray(frame.status) & 1).astype(bool)
            times_ns = np.asarray(frame.timestamp).astype(np.int64)
        except Exception as error:
            raise FileFormatError(f'{self.files[number]}: scan {number}: {error}') from error
        if not is_valid.any():
            raise FileFormatError(f'{self.files[number]}: scan {number} has no valid column')
        is_hit = (fields['RANGE'].reshape(-1, len(is_valid)) > 0) & is_valid
        rows, columns = np.nonzero(is_hit)
        chosen = rows * len(is_valid) + columns
        times_ns -= times_ns[is_valid].min()
        intensity = next(fields[name] for name in INTENSITIES if name in fields)
        chosen_points = points[chosen].astype(np.float32, order='F')  # other layouts compile anew
        return chosen_points, {
            'intensity': intensity[chosen].astype(np.float32),
            'ring': rows.astype(np.uint16),
            't': times_ns[columns].astype(np.uint32),
        }


class Frames(NamedTuple):
    """Scans of a capture, by either interface of ouster-sdk."""

    num_lidars: int
    stamps_ns: list[int]
    frame: Callable[[int], Any]
    """Returns the columns of the scan of a number."""
    to_points: Callable[[Any], npt.NDArray[Any]]
    """Returns the points of such a scan, m, in the frame of the sensor."""


def reader_of_sdk(path: Path) -> Callable[[str], Frames]:
    """Return what reads captures by the installed ouster-sdk, or raise DependencyError."""
    try:
        version = metadata.version('ouster-sdk')
        import ouster.sdk  # noqa: F401
    except ImportError as error:
        raise DependencyError(
            f'{path}: ouster-sdk cannot be loaded ({error}). It reads packets of Ouster lidars; '
            f'install it with `{INSTALL}`'
        ) from error
    for start, read in (('1.', read_by_1_0), ('0.12.', read_by_0_12)):
        if version.startswith(start):
            return read
    raise DependencyError(
        f'{path}: ouster-sdk is {version}, expected 0.12 or 1; install one with `{INSTALL}`'
    )


def read_by_1_0(path: str) -> Frames:
    """Return the scans of a capture by the interface of ouster-sdk 1.0."""
    from ouster.sdk import core, pcap

    source = pcap.PcapFrameSetSource(path, index=True)
    lidars = source.sensor_info
    return Frames(
        len(lidars),
        [int(at_us) * 1000 for at_us, _ in source.full_index],
        lambda number: source[number][0],
        core.XYZLutFloat(lidars[0], use_extrinsics=True),
    )


def read_by_0_12(path: str) -> Frames:
    """Return the scans of a capture by the interface of 0.12, which prints, and has no stamps."""
    from ouster.sdk import client, pcap

    client.init_logger('off')
    with contextlib.redirect_stdout(io.StringIO()):
        source = pcap.PcapScanSource(path, index=True)
    arrivals = [first_arrival_ns(frames[0]) for frames in source]
    return Frames(
        len(source.metadata),
        [round(at_ns / 1000) * 1000 for at_ns in arrivals],  # it keeps them as float64, in s
        lambda number: source[number][0],
        client.XYZLut(source.metadata[0], use_extrinsics=True),
    )


def first_arrival_ns(frame: Any) -> int:
    """Return when the first packet of a scan arrived; packets that did not come have 0."""
    arrivals_ns = np.asarray(frame.packet_timestamp)
    came = arrivals_ns[arrivals_ns > 0]
    return int(came.min()) if came.size else 0
