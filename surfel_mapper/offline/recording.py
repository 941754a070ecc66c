# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Recordings that can be replayed: bags and folders of scans, with the same members.

``open_recording`` opens the path of a ``Request`` and finds its topics and poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.config import Config
from surfel_mapper.errors import BagError
from surfel_mapper.offline.bag_recording import BagRecording
from surfel_mapper.offline.pose_sources import PosePath
from surfel_mapper.offline.request import Request
from surfel_mapper.offline.scan_folder import is_scans, ScanFolder

Recording = BagRecording | ScanFolder
"""
Scans with their poses: ``config`` for the mapper, with the source of the poses, ``cuts`` (files
that end too early), ``num_scans`` and ``recorded_s`` of the part that is mapped, ``describe`` for
the summary, and ``replay``, which feeds the scans to a mapper and yields the update of each.
"""


@contextmanager
def open_recording(request: Request, config: Config) -> Iterator[Recording]:
    """
    Open the recording of a request for a with-block.

    Raises
    ------
    BagError
        If the path is neither a bag nor a folder of scans, or lacks a topic or poses.
    FileFormatError
        If the file of poses cannot be read.

    """
    poses = None if request.poses is None else PosePath(request.poses, request.poses_format)
    if is_scans(request.path):
        named = [*request.topics, *request.mounts, *request.static_topics, *request.time_offsets]
        named += filter(None, [request.pose_topic])
        if named:
            raise BagError(f'{request.path}: files of scans have no topic {named[0]}')
        yield ScanFolder(request, config, poses)
        return
    with BagReader(request.path) as reader:
        yield BagRecording(reader, request, config, poses)
