# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What became of the primitives of a map from one update to the next."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ModelUpdate:
    """
    What became of the primitives since the update before.

    Attributes
    ----------
    created, updated, removed : tuple of int
        Ids that are new, that stand for something else than before, that are no more; each in
        one of these at most, in ascending order. Those of splits are created, those that were
        merged are removed.
    merged : tuple of (int, int)
        Planes and surfaces that are no more, and those that they went into.
    split : tuple of (int, int)
        Planes and surfaces, and the new ones that were part of them.
    milliseconds : float
        What it took.
    num_changed : int
        Voxels that had changed.

    """

    created: tuple[int, ...]
    updated: tuple[int, ...]
    removed: tuple[int, ...]
    merged: tuple[tuple[int, int], ...]
    split: tuple[tuple[int, int], ...]
    milliseconds: float
    num_changed: int
