# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""All harnesses by name, each with its seeds and the number of mutations in the tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from test.fuzz import corpus, files, messages, point_files, structures


class Harness(NamedTuple):
    """A function that must accept any bytes, with its seeds."""

    one_input: Callable[[bytes], None]
    corpus: Callable[[], list[bytes]]
    number: int
    """Mutations in the tests: about a second of each."""


HARNESSES = {
    'cloud_bytes': Harness(messages.cloud_bytes, corpus.clouds, 4000),
    'cloud_message': Harness(messages.cloud_message, corpus.noise, 4000),
    'depth_image': Harness(messages.depth_image, corpus.noise, 1500),
    'packed_image': Harness(messages.packed_image, corpus.packed_images, 1500),
    'drive': Harness(messages.drive, corpus.noise, 200),
    'mcap': Harness(files.mcap, corpus.mcap, 80),
    'sqlite': Harness(files.sqlite, corpus.sqlite, 80),
    'ros1': Harness(files.ros1, corpus.ros1, 80),
    'metadata': Harness(files.metadata, corpus.metadata, 100),
    'packed': Harness(files.packed, corpus.packed, 1000),
    'ply': Harness(files.points_ply, corpus.points_ply, 1000),
    'pcd': Harness(files.points_pcd, corpus.points_pcd, 1000),
    'raw': Harness(files.points_raw, corpus.points_raw, 1000),
    'parquet': Harness(files.parquet, corpus.parquet, 80),
    'state_bytes': Harness(files.state_bytes, corpus.state_bytes, 150),
    'state_content': Harness(files.state_content, corpus.noise, 80),
    'trajectory': Harness(files.trajectory, corpus.trajectory, 400),
    'kitti_times': Harness(files.kitti_times, corpus.kitti_times, 400),
    'settings': Harness(files.settings, corpus.settings, 300),
    'chain': Harness(files.chain, corpus.chain, 300),
    'mcap_structure': Harness(structures.mcap, corpus.noise, 60),
    'ros1_structure': Harness(structures.ros1, corpus.noise, 100),
    'sqlite_structure': Harness(structures.sqlite, corpus.noise, 100),
    'png_structure': Harness(structures.png, corpus.noise, 100),
    'yaml_structure': Harness(structures.yaml, corpus.noise, 25),
    'npz_structure': Harness(structures.npz, corpus.noise, 200),
    'cloud_structure': Harness(structures.cloud, corpus.noise, 200),
    'data_set': Harness(structures.data_set, corpus.noise, 400),
    'parquet_structure': Harness(structures.parquet, corpus.noise, 40),
    'las': Harness(point_files.las, corpus.las, 150),
    'las_structure': Harness(point_files.las_structure, corpus.noise, 80),
    'ply_structure': Harness(point_files.ply_structure, corpus.noise, 300),
    'pcd_structure': Harness(point_files.pcd_structure, corpus.noise, 300),
    'trajectory_structure': Harness(point_files.trajectory_structure, corpus.noise, 100),
    'tile': Harness(point_files.tile, corpus.tile, 60),
    'shown': Harness(point_files.shown, corpus.shown, 300),
    'packets': Harness(point_files.packets, corpus.noise, 200),
    'map_url': Harness(files.map_url, corpus.map_url, 1000),
    'map_name': Harness(files.map_name, corpus.map_url, 1000),
}
