# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The recording to map, and the part of it.

A ``Request`` names both in plain values, so that it can be sent to another process; ``span_of``
turns its times into a ``Span`` of record times. A part needs poses from a little before its first
cloud, to interpolate, and from after its last, because poses come late. Static transforms hold
for all time, wherever they were recorded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
import math
from pathlib import Path

from surfel_mapper.errors import BagError

MARGIN_NS = 5_000_000_000
"""Poses are read from 5 s before the part to 5 s after it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """
    Recording to map, and options for reading it.

    Attributes
    ----------
    path : Path
        A bag or a folder of scans.
    topics : tuple of str
        Topics of clouds; empty: the only one of the bag.
    pose_topic : str, optional
        Topic of poses, if there are several.
    static_topics : tuple of str
        Topics of static transforms; empty: those in the namespaces of clouds and poses.
    poses : Path, optional
        A file of poses of frames.base instead.
    poses_format : str, optional
        tum, kitti, csv or g2o.
    poses_from : str, optional
        Source of the poses: auto, tf, odometry, pose, file, registration or identity; without,
        the configuration decides.
    mounts : mapping of str to 7 floats
        Pose of the sensor of each topic in frames.base, x y z qx qy qz qw.
    time_offsets : mapping of str to float
        Seconds added to the stamps of clouds of a topic, beside ``input.time_offset_s``.
    start_s, duration_s, every : float, float, int
        The part to map; see ``span_of``.
    bin_columns : int, optional
        Number of columns of .bin files; without, that which fits their values.

    """

    path: Path
    topics: tuple[str, ...] = ()
    pose_topic: str | None = None
    static_topics: tuple[str, ...] = ()
    poses: Path | None = None
    poses_format: str | None = None
    poses_from: str | None = None
    mounts: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    time_offsets: Mapping[str, float] = field(default_factory=dict)
    start_s: float = 0.0
    duration_s: float = math.inf
    every: int = 1
    bin_columns: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """
    Part of a recording, by record time.

    Attributes
    ----------
    start_ns, stop_ns : int, optional
        Record time of the first cloud in the part, and of the first one after it.
    every : int
        1: all clouds are mapped; n: the first of every n of a topic.

    """

    start_ns: int | None = None
    stop_ns: int | None = None
    every: int = 1

    def holds(self, record_ns: int) -> bool:
        """Return whether a cloud recorded at this time is in the part."""
        begun = self.start_ns is None or record_ns >= self.start_ns
        return begun and (self.stop_ns is None or record_ns < self.stop_ns)

    @property
    def poses_start_ns(self) -> int | None:
        """Record time from which poses are read; None: from the start."""
        return None if self.start_ns is None else self.start_ns - MARGIN_NS

    @property
    def poses_stop_ns(self) -> int | None:
        """Record time up to which poses are read; None: to the end."""
        return None if self.stop_ns is None else self.stop_ns + MARGIN_NS

    def clipped(self, first_ns: int, last_ns: int) -> tuple[int, int]:
        """Return record time of first and last message of the part of a recording."""
        start_ns = first_ns if self.start_ns is None else max(self.start_ns, first_ns)
        stop_ns = last_ns if self.stop_ns is None else min(self.stop_ns, last_ns)
        return start_ns, max(stop_ns, start_ns)


WHOLE = Span()
"""All of a recording."""


def span_of(request: Request, first_ns: int, last_ns: int) -> Span:
    """
    Return the part of a recording, from its first to its last message, that is asked for.

    Raises
    ------
    BagError
        If the part begins outside of the recording, or its length or ``every`` is not positive.

    """
    whole_s = (last_ns - first_ns) / 1e9
    path, start_s, duration_s = request.path, request.start_s, request.duration_s
    if not 0.0 <= start_s <= whole_s:
        raise BagError(f'{path}: start {start_s:g} s, expected 0 to {whole_s:.3f} s')
    if not duration_s > 0.0:
        raise BagError(f'{path}: duration {duration_s:g} s, expected more than 0')
    if request.every < 1:
        raise BagError(f'{path}: every {request.every}, expected 1 or more')
    start_ns = first_ns + round(start_s * 1e9)
    return Span(
        start_ns=start_ns if start_s > 0.0 else None,
        stop_ns=None if duration_s > whole_s else start_ns + round(duration_s * 1e9),
        every=request.every,
    )
