# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Recognition of places in the surfels around keyframes, whatever the pose and the heading.

map-closures projects the points of a local map onto the ground, and compares ORB features of the
density image by a binary search tree; the rotation and translation in the plane follow from the
matches. The local maps here are the means of surfels of several scans, so that a narrow field of
view sees as much as a full turn.

Source: Gupta et al. 2024, Effectively Detecting Loop Closures using Point Cloud Density Maps.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.loops import Loop
from surfel_mapper.errors import DependencyError
from surfel_mapper.geometry import inverse

Floats = npt.NDArray[np.float64]

LEAST_POINTS = 100
"""Local maps of fewer points are not compared: their density image has no features."""


class Recognition:
    """
    The local maps of keyframes, to be compared with later ones.

    Parameters
    ----------
    min_votes : int
        Minimum number of features that agree.

    Raises
    ------
    DependencyError
        If map-closures is not installed.

    """

    def __init__(self, min_votes: int) -> None:
        self._min_votes = min_votes
        self._closures = import_map_closures().MapClosures()
        self._numbers: list[int] = []

    def add(self, number: int, points: Floats, num_candidates: int = 3) -> list[Loop]:
        """
        Add the local map of a keyframe; return earlier keyframes that show the same place.

        Parameters
        ----------
        number : int
            Number of the keyframe.
        points : (N, 3) float64, m
            Its local map in its own frame, whose z axis is about vertical.
        num_candidates : int
            Maximum number of results, those with most votes.

        """
        if len(points) < LEAST_POINTS:
            return []
        self._numbers.append(number)
        loops = self._closures.get_closures(len(self._numbers) - 1, points)
        agreeing = [loop for loop in loops if loop.number_of_inliers >= self._min_votes]
        agreeing.sort(key=lambda loop: -loop.number_of_inliers)
        return [
            Loop(
                source=number,
                target=self._numbers[loop.source_id],
                T_target_source=inverse(np.asarray(loop.pose, np.float64)),
                votes=int(loop.number_of_inliers),
            )
            for loop in agreeing[:num_candidates]
        ]


def import_map_closures() -> Any:
    """
    Return the module of map-closures.

    Raises
    ------
    DependencyError
        If it is not installed.

    """
    try:
        from map_closures import map_closures
    except ImportError as error:
        raise DependencyError(
            'recognising places needs map-closures, which is not installed; '
            "pip install 'surfel_mapper[loops]'"
        ) from error
    return map_closures
