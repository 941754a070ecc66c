# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Paint ellipses over an image.

matplotlib takes 20 microseconds for an ellipse, so drawing a map of a million surfels would take
longer than mapping; this takes 0.3 for an ellipse of a few pixels.
"""

import math

from numba import njit


@njit(cache=True, nogil=True)
def paint_discs(discs, colours, image):
    """
    Paint ellipses over an image, the last on top, with anti-aliased rims.

    discs    (K, 5) float64, px: column and row of the centre, half its length and half its
             width, and the angle of its length from the columns towards the rows, rad
    colours  (K, 3) float32
    image    (H, W, 3) float32; the centre of the first pixel is at 0, 0

    The coverage of a pixel is the distance of its centre from the rim, along the line through the
    centre of the ellipse.
    """
    height, width = image.shape[0], image.shape[1]
    for d in range(len(discs)):
        u, v, length, breadth, angle = discs[d]
        cos, sin = math.cos(angle), math.sin(angle)
        reach_u = math.hypot(length * cos, breadth * sin) + 1.0
        reach_v = math.hypot(length * sin, breadth * cos) + 1.0
        first_row = int(max(math.ceil(v - reach_v), 0.0))
        last_row = int(min(math.floor(v + reach_v), height - 1.0))
        first_column = int(max(math.ceil(u - reach_u), 0.0))
        last_column = int(min(math.floor(u + reach_u), width - 1.0))
        for row in range(first_row, last_row + 1):
            dv = row - v
            for column in range(first_column, last_column + 1):
                du = column - u
                radius = math.hypot(
                    (du * cos + dv * sin) / length, (dv * cos - du * sin) / breadth
                )
                cover = 1.0
                if radius > 0.0:
                    cover = 0.5 + math.hypot(du, dv) * (1.0 / radius - 1.0)
                if cover <= 0.0:
                    continue
                cover = min(cover, 1.0)
                for k in range(3):
                    below = image[row, column, k]
                    image[row, column, k] = below + cover * (colours[d, k] - below)
