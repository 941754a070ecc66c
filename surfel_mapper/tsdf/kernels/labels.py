# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Labels of voxels: read from an image by vote, and fused in one of four ways.

Numbers of a voxel, ``votes`` (V, N) float32:

    MAJORITY  V = labels      how often each label was seen
    FIRST_K   V = 2 k         label + 1 (0: empty) and weight of each slot, the first k labels seen
    SINGLE    V = 2           label + 1 and its lead: Boyer and Moore's majority vote, weighted
    BINARY    V = 2           how often label 0 was seen, how often another

A label is kept as float32, which is exact up to 2^24. Label -1 says nothing.

MAJORITY is what adding log-likelihoods comes to where every label but the one seen gets the same:
their difference is that of the counts times log(c / (1 - c)), c the confidence.
"""

from numba import njit
import numpy as np

from surfel_mapper.tsdf.kernels.channels import pixel, SKIP

NONE = 0
MAJORITY = 1
FIRST_K = 2
SINGLE = 3
BINARY = 4

_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)


@njit(cache=True, nogil=True, error_model='numpy')
def vote_labels(image, tau, u, v, mixed, signed, label):
    """
    Find the label of every voxel of the band: of the pixels mixed, that with the largest share.

    image  (rows, columns) int32
    label  (N,) int32, out; -1 where there is none; the smaller one on a tie
    """
    names, shares = np.empty(4, np.int32), np.empty(4, np.float32)
    for n in range(len(signed)):
        label[n] = -1
        if signed[n] == SKIP or signed[n] >= tau:
            continue
        i, j, du, dv = pixel(u[n], v[n], mixed[n])
        if mixed[n] == 0:
            label[n] = image[j, i]
            continue
        names[0], names[1] = image[j, i], image[j, i + 1]
        names[2], names[3] = image[j + 1, i], image[j + 1, i + 1]
        shares[0], shares[1] = (_ONE - du) * (_ONE - dv), du * (_ONE - dv)
        shares[2], shares[3] = (_ONE - du) * dv, du * dv
        best, most = np.int32(-1), _ZERO
        for one in range(4):
            share = _ZERO
            for other in range(4):
                share += shares[other] if names[other] == names[one] else _ZERO
            if share > most or (share == most and names[one] < best):
                best, most = names[one], share
        label[n] = best


@njit(cache=True, nogil=True, error_model='numpy')
def keep_labels(wanted, tau, label, signed):
    """
    Leave out the voxels of the extra band that are not of certain labels; return how many.

    wanted  (L,) int32
    """
    left_out = 0
    for n in range(len(signed)):
        if signed[n] == SKIP or signed[n] > -tau:
            continue
        found = False
        for one in wanted:
            found = found or one == label[n]
        if not found:
            signed[n] = SKIP
            left_out += 1
    return left_out


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_labels(semantics, tau, skip_extra, label, signed, weight, votes):
    """
    Take the labels of a measurement into those of a block; return how many found no slot.

    label, signed, weight  (N,)
    votes                  (V, N) float32, see above
    """
    overflow = 0
    for n in range(len(label)):
        if label[n] < 0 or weight[n] == _ZERO or signed[n] >= tau:
            continue
        if skip_extra and signed[n] <= -tau:
            continue
        if semantics == MAJORITY:
            if label[n] < votes.shape[0]:
                votes[label[n], n] += _ONE
        elif semantics == FIRST_K:
            overflow += vote_slot(np.float32(label[n] + 1), weight[n], votes, n)
        elif semantics == SINGLE:
            vote_single(np.float32(label[n] + 1), weight[n], votes, n)
        elif semantics == BINARY:
            votes[1 if label[n] > 0 else 0, n] += _ONE
    return overflow


@njit(cache=True, nogil=True, error_model='numpy')
def vote_slot(name, weight, votes, n):
    """Add weight to the slot of a label or to the first empty one; return 1 if all are taken."""
    for slot in range(votes.shape[0] // 2):
        if votes[2 * slot, n] == name or votes[2 * slot, n] == _ZERO:
            votes[2 * slot, n] = name
            votes[2 * slot + 1, n] += weight
            return 0
    return 1


@njit(cache=True, nogil=True, error_model='numpy')
def vote_single(name, weight, votes, n):
    """Let a label gain on the one kept, or take its place."""
    if votes[0, n] == name:
        votes[1, n] += weight
    elif weight >= votes[1, n]:
        votes[0, n], votes[1, n] = name, weight - votes[1, n]
    else:
        votes[1, n] -= weight
