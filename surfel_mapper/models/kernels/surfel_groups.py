# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Groups of surfels: connected components, sorting by group, merged moments and mean normals.

A component is named by the row of its voxel of least key, so that names need no table and do not
depend on the order in which voxels appeared.
"""

import numpy as np

from surfel_mapper.kernels.compiling import kernel
from surfel_mapper.models.kernels.region_merging import find_root

LEAST_SHARE = 0.4
"""Least length of the mean of unit normals within 60 deg of it, with some outliers."""


@kernel(error_model='numpy')
def rows_of_groups(group, flags, extra, rows):
    """
    List the rows whose group is flagged; return how many there are.

    group  (R,) int32, -1 for none
    flags  (R,) bool, by group
    extra  (R,) bool, rows to list in any case
    rows   (R,) int32, out
    """
    num = 0
    for row in range(len(group)):
        if extra[row] or (group[row] >= 0 and flags[group[row]]):
            rows[num] = row
            num += 1
    return num


@kernel(error_model='numpy')
def connected_components(rows, links, neighbours, index_of, parent):
    """
    Find the connected components of linked voxels.

    rows        (M,) int32
    links       (R,) uint64
    neighbours  (R, 2 H) int32
    index_of    (R,) int32, all -1; restored afterwards
    parent      (M,) int64, out: index of the first voxel of the component
    """
    for i in range(len(rows)):
        index_of[rows[i]] = i
        parent[i] = i
    for i in range(len(rows)):
        bits, h = links[rows[i]], 0
        while bits:
            if bits & np.uint64(1):
                j = index_of[neighbours[rows[i], h]]
                if j >= 0:
                    root_i, root_j = find_root(parent, i), find_root(parent, np.int64(j))
                    parent[max(root_i, root_j)] = min(root_i, root_j)
            bits >>= np.uint64(1)
            h += 1
    for i in range(len(rows)):
        parent[i] = find_root(parent, i)
        index_of[rows[i]] = -1


@kernel(error_model='numpy')
def name_components(rows, parent, key, component):
    """
    Name every component by its voxel of least key.

    rows, parent  of connected_components
    key           (R,) int64
    component     (R,) int32, out for these rows
    """
    least = np.empty(len(rows), np.int64)
    for i in range(len(rows)):
        least[i] = i
    for i in range(len(rows)):
        root = parent[i]
        if key[rows[i]] < key[rows[least[root]]]:
            least[root] = i
    for i in range(len(rows)):
        component[rows[i]] = rows[least[parent[i]]]


@kernel(error_model='numpy')
def sort_by_group(rows, group, number_of, ordered, starts):
    """
    Sort rows by group, in the order in which groups and rows first appear.

    rows       (M,) int32
    group      (R,) int32, of each row
    number_of  (R,) int32, all -1; restored afterwards
    ordered    (M,) int32, out
    starts     (M + 1,) int64, out: start of each group, and M

    Returns the number of groups.
    """
    num = 0
    of_row = np.empty(len(rows), np.int64)
    for i in range(len(rows)):
        name = group[rows[i]]
        if number_of[name] < 0:
            number_of[name] = num
            starts[num + 1] = 0
            num += 1
        of_row[i] = number_of[name]
        starts[of_row[i] + 1] += 1
    starts[0] = 0
    filled = np.empty(num, np.int64)
    for k in range(num):
        filled[k] = starts[k]
        starts[k + 1] += starts[k]
    for i in range(len(rows)):
        number_of[group[rows[i]]] = -1
        ordered[filled[of_row[i]]] = rows[i]
        filled[of_row[i]] += 1
    return num


@kernel(error_model='numpy')
def mean_normals(rows, starts, flat, normal, means):
    """
    Compute the mean unit normals of groups, from their flat voxels only.

    Normals of a chart lie within a cone. If they cancel, the voxels have no common viewpoint; they
    are then flipped to the side of the majority.

    rows    (M,) int32; group k has those from starts[k] to starts[k + 1] - 1
    flat    (R,) bool
    normal  (R, 3) float64
    means   (K, 3) float64, out
    """
    for k in range(len(starts) - 1):
        mean = means[k]
        mean[:] = 0.0
        for turn in range(3):
            x = y = z = 0.0
            num = 0
            for i in range(starts[k], starts[k + 1]):
                n = normal[rows[i]]
                if not flat[rows[i]]:
                    continue
                if turn == 1 and num == 0:
                    mean[0], mean[1], mean[2] = n[0], n[1], n[2]
                cosine = n[0] * mean[0] + n[1] * mean[1] + n[2] * mean[2]
                side = -1.0 if turn > 0 and cosine < 0.0 else 1.0
                x, y, z = x + side * n[0], y + side * n[1], z + side * n[2]
                num += 1
            length = np.sqrt(x * x + y * y + z * z)
            scale = 1.0 / length if length > 0.0 else 0.0
            mean[0], mean[1], mean[2] = scale * x, scale * y, scale * z
            if turn == 0 and length > LEAST_SHARE * num:
                break


@kernel(error_model='numpy')
def find_doubtful(rows, starts, means, normal, position, rules, is_doubtful):
    """
    Find groups that may be folded or overlap themselves.

    rules        least cosine of a normal to the mean; least height along the mean normal, m
    is_doubtful  (K,) bool, out
    """
    for k in range(len(starts) - 1):
        low, high, least = np.inf, -np.inf, 1.0
        x, y, z = means[k, 0], means[k, 1], means[k, 2]
        for i in range(starts[k], starts[k + 1]):
            row = rows[i]
            cosine = x * normal[row, 0] + y * normal[row, 1] + z * normal[row, 2]
            height = x * position[row, 0] + y * position[row, 1] + z * position[row, 2]
            least = min(least, cosine)
            low, high = min(low, height), max(high, height)
        is_doubtful[k] = least < rules[0] or high - low > rules[1]


@kernel(error_model='numpy')
def sample_voxels(rows, position, axes, low, voxel_size, points):
    """
    Write nine points for each voxel, three by three across its surfel, clipped to the voxel.

    rows        (M,) int32
    position    (R, 3), axes (R, 2, 3) float64
    low         (M, 3) float64, lowest corner of each voxel, m
    voxel_size  m
    points      (9 M, 3) float64, out
    """
    at = 0
    for i in range(len(rows)):
        row = rows[i]
        for a in range(-1, 2):
            for b in range(-1, 2):
                for j in range(3):
                    value = position[row, j] + a * axes[row, 0, j] + b * axes[row, 1, j]
                    points[at, j] = min(max(value, low[i, j]), low[i, j] + voxel_size)
                at += 1


@kernel(error_model='numpy')
def merge_voxels(rows, starts, count, position, covariance, total, mean, merged):
    """
    Merge the moments of voxels, by the exact formula for two sets of points.

    rows        (M,) int32; group k has those from starts[k] to starts[k + 1] - 1
    count       (R,), position (R, 3), covariance (R, 6)
    total       (K,) int64, out: points
    mean        (K, 3) float64, out
    merged      (K, 6) float64, out: covariance, xx xy xz yy yz zz
    """
    for k in range(len(starts) - 1):
        first, points = rows[starts[k]], 0.0
        sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
        for i in range(starts[k], starts[k + 1]):
            row = rows[i]
            n = np.float64(count[row])
            x, y, z = (
                position[row, 0] - position[first, 0],
                position[row, 1] - position[first, 1],
                position[row, 2] - position[first, 2],
            )
            points += n
            sx, sy, sz = sx + n * x, sy + n * y, sz + n * z
            xx += n * x * x + (n - 1.0) * covariance[row, 0]
            xy += n * x * y + (n - 1.0) * covariance[row, 1]
            xz += n * x * z + (n - 1.0) * covariance[row, 2]
            yy += n * y * y + (n - 1.0) * covariance[row, 3]
            yz += n * y * z + (n - 1.0) * covariance[row, 4]
            zz += n * z * z + (n - 1.0) * covariance[row, 5]
        mx, my, mz = sx / points, sy / points, sz / points
        scale = 1.0 / max(points - 1.0, 1.0)
        total[k] = np.int64(points)
        mean[k, 0], mean[k, 1], mean[k, 2] = (
            position[first, 0] + mx,
            position[first, 1] + my,
            position[first, 2] + mz,
        )
        merged[k, 0], merged[k, 1] = scale * (xx - sx * mx), scale * (xy - sx * my)
        merged[k, 2], merged[k, 3] = scale * (xz - sx * mz), scale * (yy - sy * my)
        merged[k, 4], merged[k, 5] = scale * (yz - sy * mz), scale * (zz - sz * mz)


@kernel(error_model='numpy')
def common_labels(labels, starts, common):
    """
    Find the groups whose members all have the same label.

    labels  (M,) int32
    starts  (K + 1,) int64, first member of each group, and M
    common  (K,) int64, out: that label, -1 for several
    """
    for k in range(len(common)):
        common[k] = labels[starts[k]]
        for i in range(starts[k] + 1, starts[k + 1]):
            if labels[i] != common[k]:
                common[k] = -1
                break
