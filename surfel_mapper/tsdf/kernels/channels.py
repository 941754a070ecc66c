# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Masks, colours and stamps of the voxels of a block, where there are any.

A voxel takes from an image what it took its range from: the four pixels that were mixed, with the
same shares, or the one nearest. Colours are mixed; masks are voted on. A voxel is inside the band
if its signed distance is less than the truncation; one that is just -tau stands for the extra
band behind, and one that is tau is free.
"""

from numba import njit
import numpy as np

_HALF = np.float32(0.5)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)

SKIP = np.float32(-1e30)
"""Signed distance of a voxel that is not observed."""


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def pixel(u, v, mixed):
    """Return column, row and the shares to the right and below of the pixels of a voxel."""
    right, below = u + _ONE, v + _ONE
    i, j = np.int64(right), np.int64(below)
    du, dv = right - np.float32(i), below - np.float32(j)
    if mixed == 0:
        return i - (du < _HALF), j - (dv < _HALF), _ZERO, _ZERO
    return i - 1, j - 1, du, dv


@njit(cache=True, nogil=True, error_model='numpy')
def apply_mask(mask, tau, u, v, mixed, signed):
    """
    Leave out the voxels of masked pixels unless they are free; return how many.

    mask    (rows, columns) uint8, 1 where masked
    signed  (N,) float32 m, SKIP where a voxel is left out
    """
    left_out = 0
    for n in range(len(signed)):
        if signed[n] == SKIP or signed[n] >= tau:
            continue
        i, j, du, dv = pixel(u[n], v[n], mixed[n])
        share = _ONE if mask[j, i] != 0 else _ZERO
        if mixed[n] != 0:
            share *= (_ONE - du) * (_ONE - dv)
            share += du * (_ONE - dv) if mask[j, i + 1] != 0 else _ZERO
            share += (_ONE - du) * dv if mask[j + 1, i] != 0 else _ZERO
            share += du * dv if mask[j + 1, i + 1] != 0 else _ZERO
        if share > _HALF:
            signed[n] = SKIP
            left_out += 1
    return left_out


@njit(cache=True, nogil=True, error_model='numpy')
def all_known(alpha, mixed):
    """Return whether the first of (2, 2) pixels, or all where they are mixed, are not 0."""
    if mixed == 0:
        return alpha[0, 0] != 0
    return alpha[0, 0] != 0 and alpha[0, 1] != 0 and alpha[1, 0] != 0 and alpha[1, 1] != 0


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_color(image, tau, skip_extra, u, v, mixed, signed, weight, color):
    """
    Take the colours of the image into the mean colours of the band, in place.

    image   (rows, columns, 3 or 4) uint8; pixels whose fourth channel is 0 have no colour
    color   (4, N) float32: red, green, blue, and their weight
    """
    for n in range(len(signed)):
        w, s = weight[n], signed[n]
        if w == _ZERO or s >= tau or (skip_extra and s <= -tau):
            continue
        i, j, du, dv = pixel(u[n], v[n], mixed[n])
        if image.shape[2] > 3 and not all_known(image[j : j + 2, i : i + 2, 3], mixed[n]):
            continue
        together = color[3, n] + w
        gain = w / together
        for channel in range(3):
            value = np.float32(image[j, i, channel])
            if mixed[n] != 0:
                right = np.float32(image[j, i + 1, channel])
                upper = value + du * (right - value)
                left = np.float32(image[j + 1, i, channel])
                right = np.float32(image[j + 1, i + 1, channel])
                value = upper + dv * (left + du * (right - left) - upper)
            color[channel, n] += (value - color[channel, n]) * gain
        color[3, n] = together


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_stamps(stamp, weight, total, stamps):
    """
    Note when each voxel was observed.

    stamp   int64 ns
    weight  (N,) float32, of this measurement
    total   (N,) float32, of those before
    stamps  (2, N) int64 ns: first, last
    """
    for n in range(len(weight)):
        if weight[n] > _ZERO:
            if total[n] == _ZERO:
                stamps[0, n] = stamp
            stamps[1, n] = stamp


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
