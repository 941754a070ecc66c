# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""All harnesses by name, each with its seeds and the number of mutations in the tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from test.fuzz import corpus, files, messages, point_files


class Harness(NamedTuple):
    """A function that must accept any bytes, with its seeds."""

    one_input: Callable[[bytes], None]
    corpus: Callable[[], list[bytes]]
    number: int
    """Mutations in the tests: about half a second of each harness."""


HARNESSES = {
    'cloud_bytes': Harness(messages.cloud_bytes, corpus.clouds, 2000),
    'cloud_message': Harness(messages.cloud_message, corpus.noise, 2000),
    'depth_image': Harness(messages.depth_image, corpus.noise, 750),
    'packed_image': Harness(messages.packed_image, corpus.packed_images, 750),
    'drive': Harness(messages.drive, corpus.noise, 100),
    'mcap': Harness(files.mcap, corpus.mcap, 40),
    'sqlite': Harness(files.sqlite, corpus.sqlite, 40),
    'ros1': Harness(files.ros1, corpus.ros1, 40),
    'metadata': Harness(files.metadata, corpus.metadata, 50),
    'packed': Harness(files.packed, corpus.packed, 500),
    'ply': Harness(files.points_ply, corpus.points_ply, 500),
    'pcd': Harness(files.points_pcd, corpus.points_pcd, 500),
    'raw': Harness(files.points_raw, corpus.points_raw, 500),
    'parquet': Harness(files.parquet, corpus.parquet, 40),
    'state_bytes': Harness(files.state_bytes, corpus.state_bytes, 75),
    'trajectory': Harness(files.trajectory, corpus.trajectory, 200),
    'settings': Harness(files.settings, corpus.settings, 150),
    'chain': Harness(files.chain, corpus.chain, 150),
    'shown': Harness(point_files.shown, corpus.shown, 150),
    'map_url': Harness(files.map_url, corpus.map_url, 500),
}
