# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Other packages that map point clouds, measured if they can be installed.

Each has a module here, which runs in an environment of its own and imports nothing of
surfel_mapper. Versions are fixed, so that figures can be reproduced.
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
    python : str
        Version of Python that it needs, if another: 3.10.

    """

    name: str
    module: str
    requires: tuple[str, ...]
    python: str | None = None


OPEN3D = ('open3d-cpu==0.19.0',)  # later ones need libusb of the system
SMALL_GICP = ('small_gicp==1.0.1', 'numpy')


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
