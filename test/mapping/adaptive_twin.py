# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A slow twin of the adaptive cut: recursion from the roots over exact integers and rationals.

Points are integers of the lattice of the whole map, and sums of Python integers have no limit.
Covariances are rational; NumPy finds their eigenvectors.
"""

from dataclasses import dataclass
from fractions import Fraction
import itertools

import numpy as np

MIN_POINTS, MIN_SPREAD, CHILD_POINTS, CHILD_SPREAD = 10, 0.015, 8, 0.01
SIGMAS, MIN_NOISE, MAX_OFFSET, MAX_SINE = 4.0, 0.25, 0.75, 0.17
PAIRS = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]


@dataclass
class Cell:
    """A cell or voxel: level, index, exact sums about the origin, state and cut below it."""

    level: int
    index: tuple
    n: int
    total: list
    product: list
    mixed: bool = False
    cut: tuple = ()

    @property
    def mean(self):
        return np.array([float(Fraction(s, self.n)) for s in self.total])

    def shape(self):
        """Return eigenvalues and normal."""
        covariance = np.empty((3, 3))
        for (a, b), m in zip(PAIRS, self.product, strict=True):
            scatter = m - Fraction(self.total[a] * self.total[b], self.n)
            covariance[a, b] = covariance[b, a] = float(scatter / max(self.n - 1, 1))
        values, vectors = np.linalg.eigh(covariance)
        return values, vectors[:, 0]


def twin_cut(surfel_map, levels=4, max_thickness_m=0.04):
    """Return the cut as a set of (level, index, number of points)."""
    moments = surfel_map.moments()
    nodes = {}
    for row, index in enumerate(map(tuple, moments.voxel_index.tolist())):
        nodes[index] = voxel(moments, row, index)
    thickness = max_thickness_m / surfel_map.voxel_size_m * 65536
    for level in range(1, levels + 1):
        groups = {}
        for node in nodes.values():
            groups.setdefault(tuple(i >> 1 for i in node.index), []).append(node)
        nodes = {i: cell(level, i, below, thickness) for i, below in groups.items()}
    return set(itertools.chain.from_iterable(node.cut for node in nodes.values()))


def voxel(moments, row, index):
    n = int(moments.count[row])
    offset = [65536 * i + 32768 for i in index]  # of the centre from the origin
    total = [int(s) + n * d for s, d in zip(moments.total[row], offset, strict=True)]
    about = moments.total[row].tolist()
    product = [
        int(m) + offset[a] * about[b] + offset[b] * about[a] + n * offset[a] * offset[b]
        for (a, b), m in zip(PAIRS, moments.product[row], strict=True)
    ]
    return Cell(0, index, n, total, product, cut=((0, index, n),))


def cell(level, index, children, thickness):
    rows = [(c.n, *c.total, *c.product) for c in children]
    sums = [sum(column) for column in zip(*rows, strict=True)]
    node = Cell(level, index, sums[0], sums[1:4], sums[4:])
    node.cut = tuple(itertools.chain.from_iterable(child.cut for child in children))
    node.mixed = any(child.mixed for child in children) or not is_flat(node, children, thickness)
    spread = node.shape()[0][1]
    size = 65536 * 2**level
    is_wide = node.n >= MIN_POINTS and spread >= MIN_SPREAD * size**2 and len(children) > 1
    if is_wide and not node.mixed:
        node.cut = ((level, index, node.n),)
    return node


def is_flat(node, children, thickness):
    """Return whether points and children of a cell lie on its plane, as far as they can tell."""
    (e0, _, _), normal = node.shape()
    variance = (node.n - 1) * e0 / max(node.n - 3, 1)
    if variance > thickness**2:
        return False
    variance, planes = max(variance, (MIN_NOISE * thickness) ** 2), []
    offset, size = MAX_OFFSET * thickness, 65536 * 2**node.level
    for child in children:
        if abs(normal @ (child.mean - node.mean)) > offset + SIGMAS * (variance / child.n) ** 0.5:
            return False
        (f0, f1, f2), own = child.shape()
        if child.n < CHILD_POINTS:
            continue
        noise_sq = max(f0 * (child.n - 1) / (child.n - 3), (MIN_NOISE * thickness) ** 2)
        if f1 <= max(CHILD_SPREAD * (size / 2) ** 2, noise_sq):
            continue
        tilt_sq = noise_sq / child.n * sum(f / (f - noise_sq) ** 2 for f in (f1, f2))
        if np.linalg.norm(np.cross(own, normal)) > MAX_SINE + SIGMAS * tilt_sq**0.5:
            return False
        planes.append((child, own, tilt_sq))
    for (one, own, tilt_sq), (other, _, _) in itertools.permutations(planes, 2):
        apart = other.mean - one.mean
        error_sq = variance / one.n + variance / other.n + tilt_sq * (apart @ apart)
        if abs(own @ apart) > offset + SIGMAS * error_sq**0.5:
            return False
    return True
