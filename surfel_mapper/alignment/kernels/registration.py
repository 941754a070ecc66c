# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Normal equations of a scan against the planes of a map's surfels.

A cell is the mean of some points of the scan; the surfel of its voxel gives the distance from the
surface and its variance. Sums run in the order of the cells, so that equal scans give equal bits.
"""

import math

import numpy as np

from surfel_mapper.kernels.compiling import kernel
from surfel_mapper.kernels.quantisation import in_range, pack

SIGMAS_SQ = 9.0
"""Squared distance, in variances, at which a cell counts as half a fit."""

# Columns of the row of a plane: 64 bytes, a cache line.
MEAN = 0
NORMAL = 3
VARIANCE = 6
SPREAD = 7
PLANE = 8


@kernel(error_model='numpy')
def cell_keys(cells, pose, scale, bits, keys):
    """
    Compute the key of the voxel that each cell lies in.

    cells  (K, 3) float64, m, in the sensor frame
    pose   (3, 4) float64, T_map_sensor
    scale  float64, lattice units a metre
    bits   a voxel is 2^bits lattice units wide
    keys   (K,) int64, out: voxel keys, -1 outside of the grid
    """
    voxel = float(1 << bits)
    for i in range(len(cells)):
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        gx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
        gy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
        gz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        kx = np.floor(np.floor(gx * scale) / voxel)
        ky = np.floor(np.floor(gy * scale) / voxel)
        kz = np.floor(np.floor(gz * scale) / voxel)
        if in_range(kx) and in_range(ky) and in_range(kz):
            keys[i] = pack(np.int64(kx), np.int64(ky), np.int64(kz))
        else:
            keys[i] = -1


@kernel(error_model='numpy')
def number_rows(rows, number, numbered, num):
    """
    Assign numbers to the rows of a map in the order of first use; return the next number.

    rows      (K,) int32, in: rows of a map, -1 for none; out: their numbers, -1 for none
    number    (R,) int32, in and out: number of each row of the map, -1 if not numbered
    numbered  (K,) int32 or longer, out: the rows by number
    """
    for i in range(len(rows)):
        row = rows[i]
        if row < 0:
            continue
        if number[row] < 0:
            number[row] = num
            numbered[num] = row
            num += 1
        rows[i] = number[row]
    return num


@kernel(error_model='numpy')
def sum_equations(cells, pose, row_of, planes, width_sq, hessian, gradient):
    """
    Sum the normal equations of a Gauss-Newton step.

    cells     (K, 3) float64, m, in the sensor frame
    pose      (3, 4) float64, T_map_sensor
    row_of    (K,) int32, row of planes for each cell, -1 for none
    planes    (P, 8) float64: mean (m), unit normal, variance of a distance from the plane at the
              mean (m^2), and its increase with the squared distance from the mean
    width_sq  float64, m^2: squared width of Geman and McClure's kernel
    hessian   (6, 6) float64, out: for position (m) and rotation (rad) about the sensor, map axes
    gradient  (6,) float64, out

    Returns the number of cells that hit a usable surfel, and of those that fit it: a cell on its
    plane counts 1, a cell three standard deviations off a half.

    Not split although it has 90 lines: most of them are the 27 sums in registers.
    """
    a00 = a01 = a02 = a11 = a12 = a22 = 0.0
    b00 = b01 = b02 = b10 = b11 = b12 = b20 = b21 = b22 = 0.0
    c00 = c01 = c02 = c11 = c12 = c22 = 0.0
    g0 = g1 = g2 = g3 = g4 = g5 = 0.0
    met, fit = 0, 0.0
    for i in range(len(cells)):
        row = row_of[i]
        if row < 0:
            continue
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        lx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z
        ly = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z
        lz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z
        dx = lx + (pose[0, 3] - planes[row, MEAN])
        dy = ly + (pose[1, 3] - planes[row, MEAN + 1])
        dz = lz + (pose[2, 3] - planes[row, MEAN + 2])
        nx, ny, nz = planes[row, NORMAL], planes[row, NORMAL + 1], planes[row, NORMAL + 2]
        distance = nx * dx + ny * dy + nz * dz
        distance_sq = distance * distance
        along_sq = max(dx * dx + dy * dy + dz * dz - distance_sq, 0.0)
        variance = planes[row, VARIANCE] + along_sq * planes[row, SPREAD]
        if not variance < math.inf:
            continue
        met += 1
        fit += 1.0 / (1.0 + distance_sq / (SIGMAS_SQ * variance))
        kernel = width_sq / (width_sq + distance_sq)
        weight = kernel * kernel / variance
        cx, cy, cz = ly * nz - lz * ny, lz * nx - lx * nz, lx * ny - ly * nx
        wx, wy, wz = weight * nx, weight * ny, weight * nz
        vx, vy, vz = weight * cx, weight * cy, weight * cz
        a00 += wx * nx
        a01 += wx * ny
        a02 += wx * nz
        a11 += wy * ny
        a12 += wy * nz
        a22 += wz * nz
        b00 += wx * cx
        b01 += wx * cy
        b02 += wx * cz
        b10 += wy * cx
        b11 += wy * cy
        b12 += wy * cz
        b20 += wz * cx
        b21 += wz * cy
        b22 += wz * cz
        c00 += vx * cx
        c01 += vx * cy
        c02 += vx * cz
        c11 += vy * cy
        c12 += vy * cz
        c22 += vz * cz
        g0 += wx * distance
        g1 += wy * distance
        g2 += wz * distance
        g3 += vx * distance
        g4 += vy * distance
        g5 += vz * distance
    hessian[0, 0], hessian[0, 1], hessian[0, 2] = a00, a01, a02
    hessian[1, 1], hessian[1, 2], hessian[2, 2] = a11, a12, a22
    hessian[0, 3], hessian[0, 4], hessian[0, 5] = b00, b01, b02
    hessian[1, 3], hessian[1, 4], hessian[1, 5] = b10, b11, b12
    hessian[2, 3], hessian[2, 4], hessian[2, 5] = b20, b21, b22
    hessian[3, 3], hessian[3, 4], hessian[3, 5] = c00, c01, c02
    hessian[4, 4], hessian[4, 5], hessian[5, 5] = c11, c12, c22
    for i in range(1, 6):
        for j in range(i):
            hessian[i, j] = hessian[j, i]
    gradient[0], gradient[1], gradient[2] = g0, g1, g2
    gradient[3], gradient[4], gradient[5] = g3, g4, g5
    return met, fit
