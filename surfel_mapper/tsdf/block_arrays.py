# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The arrays that hold the blocks of a TSDF, M x M x M voxels each.

Block (a, b, c) spans from (a, b, c) * M * voxel_size_m to the next. Voxel (i, j, k) of it has the
number i + M (j + M k), x fastest, N = M^3 in all, and its centre at
((a, b, c) * M + (i, j, k) + 0.5) * voxel_size_m. Row r of every array belongs to one block:

    head    (R, 4) int64       key, version, stamp of the last change; see tsdf/kernels/blocks.py
    field   (R, 2, N) float32  distance in m, positive in front of a surface and negative behind
                               it; weight, 0 where a voxel was never observed
    color   (R, 4, N) float32  red, green, blue in [0, 255]; weight of the colour
    votes   (R, V, N) float32  for labels, see tsdf/kernels/labels.py; V depends on the semantics
    stamps  (R, 2, N) int64    first and last stamp, ns; 0 where a voxel was never observed

color, votes and stamps have no rows where the configuration does not ask for them. All are slabs
that grow in place, so an array is good until blocks are added and must not be kept.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import TsdfConfig
from surfel_mapper.mapping.slab import Slab
from surfel_mapper.tsdf.block_content import Blocks, some
from surfel_mapper.tsdf.kernels.blocks import HEAD

Int64 = npt.NDArray[np.int64]
Float32 = npt.NDArray[np.float32]

FIRST_ROWS = 128
"""Rows to begin with; any slab of so many is whole pages."""


class BlockArrays:
    """
    A row for each block, in as many arrays as the configuration asks for.

    Parameters
    ----------
    config : TsdfConfig
        Voxels per side, and what a voxel keeps.

    """

    def __init__(self, config: TsdfConfig) -> None:
        """Make rows that are not in use."""
        self.config = config
        voxels = self.voxels_per_block
        widths = {  # in int64
            'head': HEAD,
            'field': voxels,
            'color': 2 * voxels * config.color,
            'votes': config.votes_per_voxel * voxels // 2,
            'stamps': 2 * voxels * config.tracking,
        }
        self._slabs = {name: Slab(FIRST_ROWS, width) for name, width in widths.items() if width}
        self._row_bytes = 8 * sum(widths.values())

    @property
    def voxels_per_block(self) -> int:
        """N, the number of voxels in a block."""
        return self.config.voxels_per_side**3

    @property
    def head(self) -> Int64:
        """Key, version and stamp of each row, (R, 4); only until the map grows."""
        return self._slabs['head'].array[:, :HEAD]

    @property
    def field(self) -> Float32:
        """Distance and weight, (R, 2, N); only until the map grows."""
        return self._floats('field', 2)

    @property
    def distance(self) -> Float32:
        """Signed distances, (R, N) m, a view of field."""
        return self.field[:, 0]

    @property
    def weight(self) -> Float32:
        """Weights, (R, N), 0 where never observed, a view of field."""
        return self.field[:, 1]

    @property
    def color(self) -> Float32:
        """Colours and their weights, (R, 4, N), or no rows."""
        return self._floats('color', 4)

    @property
    def votes(self) -> Float32:
        """Votes for labels, (R, V, N), or no rows."""
        return self._floats('votes', self.config.votes_per_voxel)

    @property
    def stamps(self) -> Int64:
        """First and last stamps, (R, 2, N) ns, or no rows."""
        if 'stamps' not in self._slabs:
            return np.empty((0, 2, self.voxels_per_block), np.int64)
        return self._slabs['stamps'].array.reshape(-1, 2, self.voxels_per_block)

    def _floats(self, name: str, width: int) -> Float32:
        if name not in self._slabs:
            return np.empty((0, width, self.voxels_per_block), np.float32)
        flat = self._slabs[name].array.view(np.float32)
        return flat.reshape(-1, width, self.voxels_per_block)

    def _copied(self, rows: Int64) -> dict[str, npt.NDArray[Any]]:
        """Return a copy of what some rows hold beside their head, by name."""
        names = ('field', 'color', 'votes', 'stamps')
        return {name: some(getattr(self, name), rows) for name in names}

    def _write(self, rows: Int64, blocks: Blocks) -> None:
        """Put the content of blocks into rows, but for their head."""
        for name in self._slabs.keys() - {'head'}:
            getattr(self, name)[rows] = getattr(blocks, name)

    def _wipe(self, rows: Int64) -> None:
        """Make rows zero, but for their head."""
        for name, slab in self._slabs.items():
            if name != 'head':
                slab.array[rows] = 0

    def _grow(self) -> None:
        """Make room for twice as many rows."""
        num_rows = len(self.head)
        for slab in reversed(self._slabs.values()):  # the head, which says how many, last
            if len(slab.array) < 2 * num_rows:
                slab.grow(2 * num_rows)
