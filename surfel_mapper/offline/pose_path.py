# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Poses of a file, handed to a mapper as its scans come.

A mapper forgets what is older than a minute, so the poses cannot all be entered at first; each
scan gets those up to a little behind its stamp, which is all that interpolation needs.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surfel_mapper.errors import BagError
from surfel_mapper.files.trajectory import read_trajectory, Trajectory

if TYPE_CHECKING:
    from surfel_mapper.pipeline import Mapper

MARGIN_NS = 2_000_000_000
"""
Poses are entered from this much before the first scan, for scans that come out of order, up to as
much behind each scan, for the points at the end of its sweep.
"""


class PosePath:
    """
    The poses of frames.base in frames.fixed, from a file.

    Parameters
    ----------
    path : Path
        A trajectory; see read_trajectory.
    format_ : str, optional
        tum, kitti or csv.

    Attributes
    ----------
    trajectory : Trajectory
        The poses; without stamps, pose i is that of scan i.

    """

    def __init__(self, path: Path, format_: str | None = None) -> None:
        """Read the file."""
        self.path = path
        self.trajectory: Trajectory = read_trajectory(path, format_)
        self._next: int | None = None

    @property
    def has_stamps(self) -> bool:
        """Whether poses are known by their time, not by their number."""
        return self.trajectory.stamp_ns is not None

    def add_for(self, mapper: Mapper, stamp_ns: int, number: int) -> None:
        """
        Enter what the pose of a scan needs.

        Parameters
        ----------
        mapper : Mapper
            Takes the poses.
        stamp_ns : int
            Stamp of the scan.
        number : int
            Which scan of its topic or folder it is, from 0.

        Raises
        ------
        BagError
            If the poses have no stamps, and there are fewer of them than scans.

        """
        stamps = self.trajectory.stamp_ns
        if stamps is None:
            if number >= len(self.trajectory):
                raise BagError(
                    f'{self.path}: {len(self.trajectory)} poses, none for scan {number + 1}; '
                    'expected one for every scan, or a times.txt beside it'
                )
            self._add(mapper, number, stamp_ns)
            return
        if self._next is None:
            self._next = int(np.searchsorted(stamps, stamp_ns - MARGIN_NS))
            self._next = max(self._next - 1, 0)
        while self._next < len(stamps):
            self._add(mapper, self._next, int(stamps[self._next]))
            self._next += 1
            if stamps[self._next - 1] >= stamp_ns + MARGIN_NS:
                return

    def _add(self, mapper: Mapper, row: int, stamp_ns: int) -> None:
        frames, poses = mapper.config.frames, self.trajectory
        mapper.add_pose(frames.fixed, frames.base, stamp_ns, poses.xyz[row], poses.q_xyzw[row])
