# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Copy selected points.

Every value is written and the write position advances only after a kept one, which avoids a
branch that a random mask would mispredict.
"""

from numba import njit

from surfel_mapper.kernels.compiling import U


@njit(cache=True, nogil=True)
def compact(xyz, keep, out):
    """
    Copy the selected points, in order.

    xyz   (3, N) any type
    keep  (N,) bool
    out   (3, K) of the same type, K the number of points kept
    """
    num_out = U(out.shape[1])
    for axis in range(3):
        values, to, k, i = xyz[axis], out[axis], U(0), U(0)
        while k < num_out:
            to[k] = values[i]
            k += U(keep[i])
            i += U(1)
