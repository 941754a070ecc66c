# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A second integrator in plain numpy and float64: slow, simple, and independent.

It shares only the properties of the sensors and the range images with the code under test. Maps
are dictionaries from block to the arrays of its voxels.
"""

import numpy as np

MAX_WEIGHT = 1e5


def voxel_centres(config, block):
    """Return the centres of the voxels of a block, (N, 3) m, x fastest."""
    side = np.arange(config.voxels_per_side)
    z, y, x = np.meshgrid(side, side, side, indexing='ij')
    local = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    return (np.asarray(block) * config.voxels_per_side + local + 0.5) * config.voxel_size_m


def place_in_image(sensor, p):
    """Return column and row of (N, 3) points, nan for points out of view."""
    with np.errstate(all='ignore'):
        u = sensor.fx * p[:, 0] / p[:, 2] + sensor.cx
        v = sensor.fy * p[:, 1] / p[:, 2] + sensor.cy
        seen = (p[:, 2] > 0) & (u >= 0) & (u <= sensor.columns)
        seen &= (v >= 0) & (v <= sensor.rows)
    return np.where(seen, u, np.nan), np.where(seen, v, np.nan)


def look_up(sensor, image, difference_m, u, v):
    """Return the range at a position, 0 for none, and its pixels as (row, column, share)."""
    u0, v0 = int(np.floor(u)), int(np.floor(v))
    du, dv = u - u0, v - v0
    columns = sensor.columns
    quad = [
        (v0, u0, (1 - du) * (1 - dv)),
        (v0, u0 + 1, du * (1 - dv)),
        (v0 + 1, u0, (1 - du) * dv),
        (v0 + 1, u0 + 1, du * dv),
    ]
    inside = all(0 <= j < sensor.rows and 0 <= i < columns for j, i, _ in quad)
    if inside:
        q = np.array([float(image[j, i]) for j, i, _ in quad])
        clear = q > sensor.max_range_m
        alike = (q > 0).all() and (clear.all() or not clear.any())
        if alike and q.max() - q.min() <= difference_m:
            return float(np.dot(q, [share for _, _, share in quad])), quad
    j, i = int(np.floor(v + 0.5)), int(np.floor(u + 0.5))
    if not (0 <= j < sensor.rows and 0 <= i < columns):
        return 0.0, []
    return float(image[j, i]), [(j, i, 1.0)]


def weight(config, depth, s):
    """Return the weight of one measurement."""
    w, start, tau = depth**-2, config.voxel_size_m, config.tau_m
    if s < -start:
        w *= (tau + s) / (tau - start)
    return max(w, 1e-4)


def measurements(config, image, T_map_sensor, block, difference_m):
    """Yield voxel, signed distance, weight and pixels for every voxel observed of a block."""
    sensor, tau = image.sensor, config.tau_m
    R, t = T_map_sensor[:3, :3], T_map_sensor[:3, 3]
    points = (voxel_centres(config, block) - t) @ R
    u, v = place_in_image(sensor, points)
    masked = set(config.dynamic_labels)
    for n, p in enumerate(points):
        d = np.linalg.norm(p)
        farthest = image.largest_m + tau
        if np.isnan(u[n]) or not sensor.min_range_m <= d <= farthest:
            continue
        value, pixels = look_up(sensor, image.range_m, difference_m, u[n], v[n])
        if value <= 0 or (value > sensor.max_range_m and d > sensor.max_range_m):
            continue
        s = value - d
        if s < -tau:
            continue
        s = min(s, tau)
        if s < tau and share_of(pixels, image, masked) > 0.5:
            continue
        yield n, s, weight(config, p[2], s), pixels


def share_of(pixels, image, masked):
    """Return the share of the pixels that are masked."""
    total = 0.0
    for j, i, share in pixels:
        by_label = image.label is not None and image.label[j, i] in masked
        by_mask = image.mask is not None and image.mask[j, i] != 0
        total += share * (by_label or by_mask)
    return total


def integrate(config, blocks, image, T_map_sensor, index, difference_m=0.2):
    """Fuse an image into the blocks of a dictionary: index to (D, W, C, W of C)."""
    size = config.voxels_per_side**3
    for block in map(tuple, index):
        new = np.zeros(size), np.zeros(size), np.zeros((size, 3)), np.zeros(size)
        D, W, C, W_color = blocks.setdefault(block, new)
        for n, s, w, pixels in measurements(config, image, T_map_sensor, block, difference_m):
            D[n] = (D[n] * W[n] + s * w) / (W[n] + w)
            W[n] = min(W[n] + w, MAX_WEIGHT)
            if image.color is not None and s < config.tau_m:
                c = sum(share * image.color[j, i].astype(float) for j, i, share in pixels)
                C[n] = (C[n] * W_color[n] + c * w) / (W_color[n] + w)
                W_color[n] = min(W_color[n] + w, MAX_WEIGHT)
    return blocks
