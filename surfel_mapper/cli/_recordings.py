# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings in place of a map: verbs that take maps take bags and folders of scans too."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from surfel_mapper.cli._verbosity import shown_progress

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfel_map import SurfelMap


def recorded_map(
    args: argparse.Namespace,
    path: Path,
    forms: Sequence[str],
    voxel_size_m: float | None,
) -> SurfelMap | None:
    """
    Return the map of a recording; None for a file of points, or a directory with a map.

    Parameters
    ----------
    args : Namespace
        Its bin_columns and verbosity count.
    path : Path
        A recording or anything else.
    forms : sequence of str
        The forms of maps that the verb reads, see latest_map.py.
    voxel_size_m : float or None
        Edge of the voxels, m; see map_recording.

    """
    from surfel_mapper.bags.paths import is_ros1, is_storage
    from surfel_mapper.files.latest_map import map_in
    from surfel_mapper.offline import ouster_pcap
    from surfel_mapper.offline.filtering import is_bag
    from surfel_mapper.offline.replay import map_recording
    from surfel_mapper.offline.scan_folder import is_scans

    if path.is_dir():
        is_recording = map_in(path, forms) is None and (is_bag(path) or is_scans(path))
    else:
        is_packets = path.suffix.lower() == ouster_pcap.SUFFIX
        is_recording = path.is_file() and (is_storage(path) or is_ros1(path) or is_packets)
    if not is_recording:
        return None
    with shown_progress(args, 'scan') as show:
        return map_recording(
            path, voxel_size_m=voxel_size_m, bin_columns=args.bin_columns, progress=show
        )
