# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""small_gicp's map of Gaussian voxels, given a covariance of every point's 10 neighbours."""

from __future__ import annotations

import small_gicp

from test.bench.peers import small_gicp_means

NEIGHBOURS = 10
"""Time of small_gicp to prepare a cloud for registration."""


class Peer(small_gicp_means.Peer):
    """A map with covariances."""

    def prepared(self, cloud):
        """Return the scan with covariances."""
        small_gicp.estimate_covariances(cloud, num_neighbors=NEIGHBOURS)
        return cloud
