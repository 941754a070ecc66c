# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A scan before and after a chain of filters, as a picture.

A lidar in a simulated street gives the scan; the chain thins it to voxels of 0.3 m and marks the
ground, which is drawn in another colour.

    python examples/filter_picture.py filters.png
"""

import argparse
from pathlib import Path

import matplotlib
import numpy as np

from surfel_mapper.filters import Chain
from surfel_mapper.simulation import Lidar, Simulation, World

CHAIN = """
- range_limit: {min_m: 2, max_m: 25}
- voxel_grid: {size_x_m: 0.3, size_y_m: 0.3, size_z_m: 0.3}
- ground: {up: sensor, voxel_size_m: 1.5, min_planarity: 0.02}
"""

GREY, TEAL, AMBER = '#5f6b73', '#1b7f79', '#c9803a'


def draw(axes, points, colours, title):
    """Draw points from above and behind, far ones first."""
    x, y, z = points.T
    depth = x + 0.3 * y
    order = np.argsort(-depth)
    axes.scatter((y - 0.45 * x)[order], (z + 0.35 * x + 0.12 * y)[order], s=0.6, c=colours[order])
    axes.set_title(title, fontsize=10)
    axes.set_aspect('equal')
    axes.set_axis_off()


def main():
    """Filter a scan and draw both."""
    parser = argparse.ArgumentParser(description=str(__doc__).strip().partition('\n')[0])
    parser.add_argument('path', type=Path, help='picture to write, .png or .svg')
    args = parser.parse_args()

    matplotlib.use('Agg')
    from matplotlib import pyplot

    street = Simulation(World.street(length_m=60.0), Lidar(beams=64, columns=1024), num_scans=2)
    scan = next(iter(street.scans()))
    before = scan.points[np.isfinite(scan.points).all(axis=1)]
    before = before[np.linalg.norm(before, axis=1) < 25.0]
    after = Chain.from_yaml(CHAIN).apply(scan)
    is_ground = np.asarray(after.columns['ground']) > 0
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10.0, 3.4), layout='constrained')
    draw(left, before, np.full(len(before), GREY), f'before: {len(before):,} points within 25 m')
    colours = np.where(is_ground, TEAL, AMBER)
    draw(right, after.points, colours, f'after: {len(after):,} points, ground in green')
    figure.savefig(args.path, dpi=80)
    num_ground = np.count_nonzero(is_ground)
    print(f'{args.path}: {len(before)} -> {len(after)} points, {num_ground} ground')


if __name__ == '__main__':
    main()
