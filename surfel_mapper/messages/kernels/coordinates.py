# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Gather the coordinates of a cloud in one pass over its bytes; apart from what fills messages."""

import numpy as np

from surfel_mapper.kernels.compiling import kernel


@kernel()
def gather_coordinates(x, y, z, packed):
    """
    Copy the coordinates of all points.

    x, y, z  (H, W) float32 or float64, views into a message with any strides, aligned or not
    packed   (3, H * W) float32 or float64, out: row by row

    Lines of the cache hold all three coordinates of a point; three passes read each three times.
    """
    out = np.uint64(0)
    for row in range(np.uint64(x.shape[0])):
        for i in range(np.uint64(x.shape[1])):
            packed[0, out], packed[1, out], packed[2, out] = x[row, i], y[row, i], z[row, i]
            out += np.uint64(1)
