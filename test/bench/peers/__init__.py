# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Other packages that map point clouds, measured if they can be installed.

Each has a module here with a class ``Peer(voxel_size_m, window)``: ``step(points, T_map_sensor)``
takes a scan, (N, 3) float32 with nan, and ``num_voxels`` is the size of its map. The module is
loaded by ``driver`` in an environment of its own and imports nothing of surfel_mapper. Versions
are fixed, so that figures can be reproduced.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class PeerSpec:
    """
    A package to compare with.

    Attributes
    ----------
    name : str
        Name in the table.
    module : str
        Module of its class.
    requires : tuple of str
        Its requirements for pip.
    less : str
        Work that it leaves out.
    python : str
        Version of Python that it needs, if another: 3.10.

    """

    name: str
    module: str
    requires: tuple[str, ...]
    less: str | None = None
    python: str | None = None


OPEN3D = ('open3d-cpu==0.19.0',)  # later ones need libusb of the system
SMALL_GICP = ('small_gicp==1.0.1', 'numpy')

PEERS = (
    PeerSpec(
        name='Open3D HashMap + numpy',
        module='test.bench.peers.open3d_hashmap',
        requires=OPEN3D,
    ),
    PeerSpec(
        name='Open3D rebuild',
        module='test.bench.peers.open3d_rebuild',
        requires=OPEN3D,
        less='not exact: normals of downsampled points',
    ),
    PeerSpec(
        name='small_gicp GaussianVoxelMap, means',
        module='test.bench.peers.small_gicp_means',
        requires=SMALL_GICP,
        less='removes voxels not seen for long, never points; no covariances, no normals',
    ),
    PeerSpec(
        name='small_gicp GaussianVoxelMap, covariances',
        module='test.bench.peers.small_gicp_covariances',
        requires=SMALL_GICP,
        less='removes voxels not seen for long, never points; no normals',
    ),
    PeerSpec(
        name='KISS-ICP VoxelHashMap',
        module='test.bench.peers.kiss_icp_map',
        requires=('kiss-icp==1.3.0',),
        less='keeps 20 points a voxel, removes by distance; no moments, no normals',
    ),
)

NORMAL_PEERS = (
    PeerSpec(name='Open3D, k nearest', module='test.bench.peers.open3d_normals', requires=OPEN3D),
    PeerSpec(
        name='small_gicp, k nearest',
        module='test.bench.peers.small_gicp_normals',
        requires=SMALL_GICP,
    ),
)
"""Peers whose normals are compared; a module has ``normals(points, support)``, (N, 3) each."""

LOOP_PEERS = (
    PeerSpec(
        name='KISS-ICP',
        module='test.bench.peers.kiss_icp_odometry',
        requires=('kiss-icp==1.3.0',),
        less='no loops',
    ),
    PeerSpec(
        name='KISS-SLAM',
        module='test.bench.peers.kiss_slam_odometry',
        requires=('kiss-slam==0.0.2',),
        less='no map at the end',
    ),
)
"""Peers on a drive with loops; ``Odometry.finish()`` gives corrected poses, if there is one."""

ODOMETRY_PEERS = (
    PeerSpec(
        name='KISS-ICP',
        module='test.bench.peers.kiss_icp_odometry',
        requires=('kiss-icp==1.3.0',),
    ),
    PeerSpec(
        name='small_gicp VGICP',
        module='test.bench.peers.small_gicp_odometry',
        requires=SMALL_GICP,
    ),
)
"""Peers that find poses; a module has ``Odometry(voxel_size_m)`` with ``register(points)``."""
