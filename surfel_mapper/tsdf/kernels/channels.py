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
