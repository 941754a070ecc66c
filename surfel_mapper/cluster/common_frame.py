# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Recordings without poses in one frame: each is registered alone, then placed on the others.

Registration begins every recording at the origin. So each is replayed as a task of its own, with
its loops closed unless ``align`` is False, into ``registered_N`` of the output directory, and its
map is moved onto those of the recordings before it (evaluation/frames.py). After that all have
poses in the frame of the first, and are mapped as recordings with a file of poses: the map is the
exact one of these poses.

A recording that fits none of the others stays apart, with its own map; one wrong place would spoil
the map of all.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import logging
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.errors import AlignmentError
from surfel_mapper.evaluation.comparison import CloudTruth
from surfel_mapper.evaluation.frames import find_motion, FrameMotion, moved_discs
from surfel_mapper.evaluation.map_files import Discs, load_discs
from surfel_mapper.files.trajectory import Trajectory, write_tum
from surfel_mapper.geometry import compose, inverse
from surfel_mapper.offline.replay import replay, ReplayOptions
from surfel_mapper.offline.request import Request

log = logging.getLogger(__name__)

POSES = 'poses.tum'
"""Poses of the tracked frame, in the directory of a registered recording."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Registered:
    """
    A recording that was registered alone.

    Attributes
    ----------
    request : Request
        The recording, with the file of its poses.
    config : Config
        Settings to map it at these poses.
    directory : Path
        Its map, trajectory and report.
    first_s, last_s : float
        Stamps of its first and last scan that was mapped, s.
    scans : dict of str
        Its counts of scans, as in summary.json.
    registration : dict of str
        Figures of its registration.

    """

    request: Request
    config: Config
    directory: Path
    first_s: float
    last_s: float
    scans: dict[str, Any]
    registration: dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class CommonFrame:
    """
    Recordings in one frame.

    Attributes
    ----------
    placed : list of Registered
        Those with a place, the first of all among them.
    apart : list of (Registered, str)
        The others, and why they have none.
    motions : list of (Registered, FrameMotion)
        The motions of those that were moved.

    """

    placed: list[Registered]
    apart: list[tuple[Registered, str]]
    motions: list[tuple[Registered, FrameMotion]]

    def summary(self, scans: Mapping[str, Any]) -> dict[str, Any]:
        """
        Return what summary.json says of the registration, and the counts of scans with all apart.

        Parameters
        ----------
        scans : mapping
            The counts of the scans that were mapped in the common frame.

        """
        apart = [
            {**entry, 'map': f'{recording.directory.name}/apart_{number}'}
            for recording in self.placed
            for number, entry in enumerate(recording.registration['apart'], start=1)
        ]
        dropped, received = Counter(scans['dropped']), scans['received']
        for recording, reason in self.apart:
            apart.append(
                {
                    'scans': recording.scans['mapped'],
                    'first_s': recording.first_s,
                    'last_s': recording.last_s,
                    'reason': f'{recording.request.path.name}: {reason}',
                    'map': recording.directory.name,
                }
            )
            dropped.update(recording.scans['dropped'])
            dropped['apart'] += recording.scans['mapped']
            received += recording.scans['received']
        everyone = [*self.placed, *(recording for recording, _ in self.apart)]
        return {
            'poses_from': 'registration',
            'poses_reason': f'{len(everyone)} recordings without poses, each registered alone and '
            'placed on the others',
            'scans': {**scans, 'received': received, 'dropped': dict(dropped)},
            'registration': {
                'recordings': [self._description(recording) for recording in everyone],
                'apart': apart,
                'parts_apart': len(apart),
            },
        }

    def _description(self, recording: Registered) -> dict[str, Any]:
        """Return path, map and motion of a recording."""
        description = {'path': str(recording.request.path), 'map': recording.directory.name}
        motion = next((motion for owner, motion in self.motions if owner is recording), None)
        return description if motion is None else {**description, 'motion': motion.summary()}


def register(task: tuple[Request, Config, Path, bool | None]) -> Registered:
    """
    Register a recording alone and write its map and poses; runs on a worker.

    The last part of a task is ``ReplayOptions.align``.

    Raises
    ------
    BagError
        If the recording cannot be read, or none of its scans was mapped.
    FileFormatError
        If a file cannot be written.

    """
    request, config, directory, align = task
    result = replay(
        replace(request, poses_from='registration'),
        output=directory,
        config=config,
        options=ReplayOptions(formats=('npz',), align=align, overwrite=True),
    )
    stamps_ns, poses = beyond_the_end(result.trajectory.stamps_ns, result.trajectory.of_body)
    write_tum(directory / POSES, stamps_ns, poses)
    settings = {
        'pose.source': 'pose',
        'frames.base': result.summary['registration']['body'],
        'deskew.enabled': result.mapper.config.deskew.enabled,
    }
    return Registered(
        request=replace(request, poses=directory / POSES, poses_format='tum', poses_from='file'),
        config=config.replace(settings),
        directory=directory,
        first_s=result.trajectory.stamps_ns[0] / 1e9,
        last_s=result.trajectory.stamps_ns[-1] / 1e9,
        scans=result.summary['scans'],
        registration=result.summary['registration'],
    )


def beyond_the_end(
    stamps_ns: Sequence[int], poses: npt.NDArray[np.float64]
) -> tuple[list[int], npt.NDArray[np.float64]]:
    """Return poses with one more at constant velocity, within which the last sweep ends."""
    if len(stamps_ns) < 2:
        return list(stamps_ns), poses
    last = compose(poses[-1], compose(inverse(poses[-2]), poses[-1]))
    next_ns = 2 * stamps_ns[-1] - stamps_ns[-2]
    return [*stamps_ns, next_ns], np.concatenate([poses, last[None]])


def in_one_frame(recordings: Sequence[Registered]) -> CommonFrame:
    """
    Place recordings on each other, and rewrite their poses in the frame of the first.

    Parameters
    ----------
    recordings : sequence of Registered
        Each in a frame of its own.

    Raises
    ------
    FileFormatError
        If a map or its poses cannot be read or written.

    """
    first, *later = recordings
    whole = discs_of(first)
    placed, motions = [first], []
    waiting = [(recording, '') for recording in later]
    num_placed = 0
    while waiting and num_placed < len(placed):  # a map just placed may reach the others
        num_placed, tried, waiting = len(placed), waiting, []
        for recording, _ in tried:
            discs = discs_of(recording)
            width_m = recording.config.map.voxel_size_m
            try:
                motion = find_motion(discs, CloudTruth(whole), {}, width_m)
            except AlignmentError as error:
                waiting.append((recording, str(error)))
                continue
            move_poses(recording.directory / POSES, motion)
            whole = joined(whole, moved_discs(discs, motion.T_truth_map))
            placed.append(recording)
            motions.append((recording, motion))
    for recording, reason in waiting:
        log.warning(
            '%s could not be placed on the other recordings: %s', recording.request.path, reason
        )
    return CommonFrame(placed=placed, apart=waiting, motions=motions)


def discs_of(recording: Registered) -> Discs:
    """Return the map of a recording."""
    return load_discs(recording.directory / 'map.npz', recording.config.map.min_points)


def move_poses(path: Path, motion: FrameMotion) -> None:
    """Move the poses in a file."""
    trajectory = Trajectory.load(path)
    if trajectory.stamp_ns is not None:  # TUM has stamps
        write_tum(path, trajectory.stamp_ns, motion.T_truth_map @ trajectory.matrices)


def joined(first: Discs, second: Discs) -> Discs:
    """Return the discs of two maps in one frame."""
    normals = [discs.normal for discs in (first, second) if discs.normal is not None]
    return replace(
        first,
        position=np.concatenate([first.position, second.position]),
        normal=np.concatenate(normals) if len(normals) == 2 else None,
        digest=None,
    )
