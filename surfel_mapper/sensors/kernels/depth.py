# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Pixels of a depth image to points.

One pass over the image that skips pixels without depth; array operations need four passes over all
pixels and four temporary images. Apart from the kernels of deskewing, which need no images.
"""

from numba import njit
import numpy as np


@njit(cache=True, nogil=True)
def unproject(depth, metres, end, across, down, points):
    """
    Turn the pixels that have a depth into points; return how many there are.

    depth   (H, W) uint16 or float32, along the optical axis
    metres  float64, of one unit of depth
    end     float64, units; from here on there is no depth
    across  (W,) float64, x / z of the ray through each column
    down    (H,) float64, y / z of the ray through each row
    points  (3, H W) float32, out: x right, y down, z ahead, m; row by row

    0, negative values and nan mean no depth either.
    """
    num = 0
    for row in range(depth.shape[0]):
        slope = down[row]
        for column in range(depth.shape[1]):
            units = np.float64(depth[row, column])
            if 0.0 < units < end:
                z = units * metres
                points[0, num] = across[column] * z
                points[1, num] = slope * z
                points[2, num] = z
                num += 1
    return num
