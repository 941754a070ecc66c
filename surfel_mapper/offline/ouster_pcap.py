# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Scans of an Ouster lidar in a capture of its packets, with its metadata beside it, by ouster-sdk.

The profiles of packets differ between firmwares, and ouster-sdk knows all of them. It pins a
version of rosbags that lacks what bags/ needs, so it cannot be an extra: INSTALL says how both
live in one environment. On its own because it alone imports ouster-sdk.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import DependencyError, FileFormatError
from surfel_mapper.files.trajectory import Trajectory
from surfel_mapper.offline.pcap_packets import check_capture

SUFFIX = '.pcap'

INSTALL = "pip install more-itertools && pip install --no-deps 'ouster-sdk>=1,<2'"

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
        If it is no capture, has no metadata, no scan, or several lidars, or ouster-sdk must not
        read it, see pcap_packets.py.

    """

    format = 'packets of an Ouster lidar'
    trajectory: Trajectory | None = None
    poses_path: Path | None = None

    def __init__(self, path: Path) -> None:
        core, pcap = import_sdk(path)
        check_capture(path)
        try:
            self._frames = pcap.PcapFrameSetSource(str(path), index=True)
        except Exception as error:  # the package states no types of its errors
            raise FileFormatError(
                f'{path}: {error}; expected packets of an Ouster lidar, and its metadata (JSON) '
                'of the same name beside it'
            ) from error
        lidars = self._frames.sensor_info
        if len(lidars) != 1 or not len(self._frames):
            raise FileFormatError(
                f'{path}: {len(self._frames)} scans of {len(lidars)} lidars, expected scans of one'
            )
        self._place = core.XYZLutFloat(lidars[0], use_extrinsics=True)
        self.stamps_ns = [int(at_us) * 1000 for at_us, _ in self._frames.full_index]
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
            frame = self._frames[number][0]
            points = np.asarray(self._place(frame)).reshape(-1, 3)
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


def import_sdk(path: Path) -> tuple[Any, Any]:
    """Return two modules of ouster-sdk, or raise DependencyError with how to install it."""
    try:
        from ouster.sdk import core, pcap
    except ImportError as error:
        raise DependencyError(
            f'{path}: ouster-sdk cannot be loaded ({error}). It reads packets of Ouster lidars; '
            f'install it with `{INSTALL}`'
        ) from error
    return core, pcap
