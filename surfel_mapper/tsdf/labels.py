# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What the votes of voxels say: their labels, and how sure they are."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]


def labels_of(
    semantics: str, votes: Float32, *, min_weight: float = 0.0
) -> tuple[npt.NDArray[np.int32], Float32]:
    """
    Return the label of each voxel, and its weight.

    Parameters
    ----------
    semantics : str
        As in the configuration.
    votes : (V, ...) float32
        Of voxels, see kernels/tsdf_labels.py.
    min_weight : float
        first_k: a label counts if it weighs more.

    Returns
    -------
    (...) int32
        -1 where there is none; on a tie the smaller one, of the first k that seen first.
    (...) float32
        How often it was seen (majority, binary), its weight (first_k), or its lead (single).

    """
    if semantics in ('majority', 'binary'):
        label, weight = votes.argmax(axis=0), votes.max(axis=0)
        return np.where(weight > 0.0, label, -1).astype(np.int32), weight
    if semantics == 'single':
        return votes[0].astype(np.int32) - 1, votes[1]
    best = votes[1::2].argmax(axis=0)[None]
    label = np.take_along_axis(votes[::2], best, axis=0)[0]
    weight = np.take_along_axis(votes[1::2], best, axis=0)[0]
    return np.where(weight > min_weight, label - 1, -1).astype(np.int32), weight


def log_odds(votes: Float32, confidence: float) -> Float32:
    """
    Return the log-likelihoods of labels but for a constant, from counts, (V, ...).

    Parameters
    ----------
    votes : (V, ...) float32
        Counts of the majority.
    confidence : float
        How likely a label seen is right, in (0, 1); each of the others has the rest.

    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f'confidence: {confidence}, expected more than 0 and less than 1')
    odds: Float32 = votes * np.float32(math.log(confidence / (1.0 - confidence)))
    return odds
