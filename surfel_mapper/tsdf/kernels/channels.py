# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Masks, colours and labels of the voxels of a block.

A voxel samples these images at the pixels of its range: four pixels with the same interpolation
weights, or the nearest one. Colours are interpolated; masks and labels are voted on. A voxel is
inside the band if its signed distance is below the truncation tau, which stands for free space.

The label of a voxel is kept as two numbers, ``votes`` (2, N) float32: label + 1, 0 for none, and
its lead over all other labels by Boyer and Moore's majority vote, in measurements. Each counts as
one, near or far, as in Hydra's MLE: n of them that are right with probability c tell that a label
is (c / (1 - c))^n times as likely as another. Among two labels the lead is the difference of
their counts; with more it is exact only for one that has the majority. A lead obeys the cap of
the map, ``max_weight``. A label is stored as float32, exact up to 2^24. Label -1 means unknown.
"""

from numba import njit
import numpy as np

_HALF = np.float32(0.5)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)

SKIP = np.float32(-1e30)
"""Signed distance of voxels that are not observed."""


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def pixel(u, v, mixed):
    """Return column and row of the upper left pixel, and the weights to the right and below."""
    right, below = u + _ONE, v + _ONE
    i, j = np.int64(right), np.int64(below)
    du, dv = right - np.float32(i), below - np.float32(j)
    if mixed == 0:
        return i - (du < _HALF), j - (dv < _HALF), _ZERO, _ZERO
    return i - 1, j - 1, du, dv


@njit(cache=True, nogil=True, error_model='numpy')
def apply_mask(mask, tau, u, v, mixed, signed):
    """
    Skip the voxels of masked pixels unless they are free; return their number.

    mask    (rows, columns) uint8, 1 where masked
    signed  (N,) float32 m, in and out; SKIP for skipped voxels
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
    """Return whether the first of (2, 2) pixels, or all four if mixed, are not 0."""
    if mixed == 0:
        return alpha[0, 0] != 0
    return alpha[0, 0] != 0 and alpha[0, 1] != 0 and alpha[1, 0] != 0 and alpha[1, 1] != 0


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_color(image, bounds, u, v, mixed, signed, weight, color):
    """
    Fuse the colours of the image into the mean colours of voxels in the band, in place.

    image   (rows, columns, 3 or 4) uint8; pixels whose fourth channel is 0 have no colour
    bounds  (tau, max_weight, rate): the band; largest weight of a colour, and least share of a
            measurement
    color   (4, N) float32: red, green, blue, and their weight
    """
    tau, max_weight, rate = bounds
    for n in range(len(signed)):
        w, s = weight[n], signed[n]
        if w == _ZERO or s >= tau:
            continue
        i, j, du, dv = pixel(u[n], v[n], mixed[n])
        if image.shape[2] > 3 and not all_known(image[j : j + 2, i : i + 2, 3], mixed[n]):
            continue
        together = color[3, n] + w
        gain = max(w / together, rate)
        for channel in range(3):
            value = np.float32(image[j, i, channel])
            if mixed[n] != 0:
                right = np.float32(image[j, i + 1, channel])
                upper = value + du * (right - value)
                below = np.float32(image[j + 1, i, channel])
                right = np.float32(image[j + 1, i + 1, channel])
                value = upper + dv * (below + du * (right - below) - upper)
            color[channel, n] += (value - color[channel, n]) * gain
        color[3, n] = min(together, max_weight)


@njit(cache=True, nogil=True, error_model='numpy')
def vote_labels(image, tau, u, v, mixed, signed, label):
    """
    Find the label of every voxel in the band: that of the largest interpolation weight.

    image  (rows, columns) int32
    label  (N,) int32, out; -1 for unknown; the smaller one on a tie
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
        for first in range(4):
            share = _ZERO
            for second in range(4):
                share += shares[second] if names[second] == names[first] else _ZERO
            if share > most or (share == most and names[first] < best):
                best, most = names[first], share
        label[n] = best


@njit(cache=True, nogil=True, error_model='numpy')
def fuse_labels(tau, max_weight, rate, label, signed, weight, votes):
    """
    Fuse the labels of a measurement into the votes of a block.

    max_weight, rate       largest lead, and least share of a measurement
    label, signed, weight  (N,)
    votes                  (2, N) float32, see the module docstring
    """
    for n in range(len(label)):
        if label[n] >= 0 and weight[n] > _ZERO and signed[n] < tau:
            vote(label[n], max_weight, rate, votes, n)


@njit(cache=True, nogil=True, error_model='numpy')
def vote(label, max_weight, rate, votes, n):
    """Add one to the lead of a stored label, or take one from it; a lead below one is replaced."""
    most = min(max_weight, _ONE / rate if rate > _ZERO else max_weight)
    name = np.float32(label + 1)
    if votes[0, n] == name:
        votes[1, n] = min(votes[1, n] + _ONE, most)
    elif votes[1, n] <= _ONE:
        votes[0, n], votes[1, n] = name, _ONE - votes[1, n]
    else:
        votes[1, n] = min(votes[1, n], most) - _ONE
