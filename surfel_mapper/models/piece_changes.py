# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What changed in the pieces of a map, for those who group them.

A voxel is in the row that the map has it in. It may leave and come back in another one, after a
map was cleared and filled again, and then it is still the same voxel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Rows = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """
    What changed in the pieces.

    Attributes
    ----------
    num_voxels : int
        Voxels that came, changed or went.
    rows : (N,) int32
        Those whose label may be another now, apart from what hangs together anew.
    loose : (C,) int32
        Components that may hang together otherwise than before.
    touched : (C,) int32
        Components of which some voxel, or one that lies on it, changed at all.
    hosts : (H,) int32
        Rows on which other voxels lie now.
    gone : (G,) int32
        Labels of voxels that have gone; those that have come back elsewhere are not among them.

    """

    num_voxels: int
    rows: Rows
    loose: Rows
    touched: Rows
    hosts: Rows
    gone: Rows


@dataclass(slots=True, eq=False)
class Gone:
    """Voxels that have left their rows: keys, labels, whether alone, components."""

    key: npt.NDArray[np.int64]
    label: Rows
    alone: npt.NDArray[np.bool_]
    component: Rows

    def joined(self, other: Gone) -> Gone:
        """Return these and others."""
        names = ('key', 'label', 'alone', 'component')
        return Gone(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))

    def return_to(
        self,
        came: Rows,
        keys: npt.NDArray[np.int64],
        labels: Rows,
        alone: npt.NDArray[np.bool_],
    ) -> None:
        """
        Give the labels of voxels that are in another row now to that row.

        Parameters
        ----------
        came : (C,) int32
            Rows that hold another voxel than before.
        keys : (R,) int64
            The voxels in all rows.
        labels, alone : (R,) int32, (R,) bool
            What to change, in place.

        """
        if not len(self.key) or not len(came):
            return
        order = np.argsort(self.key)
        place = np.minimum(np.searchsorted(self.key[order], keys[came]), len(order) - 1)
        back = order[place]
        same = self.key[back] == keys[came]
        labels[came[same]] = self.label[back[same]]
        alone[came[same]] = self.alone[back[same]]
        kept = np.ones(len(self.key), np.bool_)
        kept[back[same]] = False
        self.label, self.alone = self.label[kept], self.alone[kept]

    @property
    def remaining(self) -> Rows:
        """Labels of Gaussians whose voxels are no more."""
        return self.label[self.alone]


def found(components: list[Rows]) -> Rows:
    """Return the components among these, without -1, each once."""
    every = np.unique(np.concatenate(components))
    return every[every >= 0]
