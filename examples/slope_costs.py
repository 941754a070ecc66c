# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Costs of slopes and steps as a map for Nav2's map server.

    surfel-mapper replay street/ --output mapped/
    python examples/slope_costs.py mapped/map.npz costs --max-slope 20
    ros2 run nav2_map_server map_server --ros-args -p yaml_filename:=costs.yaml

Live the node publishes the same as ``~/grid`` (``grid.rate_hz``).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from surfel_mapper.config import GridConfig
from surfel_mapper.files.map_state import load_map
from surfel_mapper.layers.costs.traversability import CostGrid, traversability

UNKNOWN = 255
"""Value of unknown cells in mode raw of the map server, which takes any above 100."""


def main() -> None:
    """Read a map, write its costs."""
    parser = argparse.ArgumentParser(description=str(__doc__).strip().partition('\n')[0])
    parser.add_argument('map', type=Path, help='map.npz of a replay, or of ~/save_map')
    parser.add_argument('output', type=Path, help='without extension: OUTPUT.pgm, OUTPUT.yaml')
    parser.add_argument('--max-slope', type=float, default=30.0, metavar='DEG')
    parser.add_argument('--max-step', type=float, default=0.25, metavar='M')
    args = parser.parse_args()

    surfel_map, _ = load_map(args.map)
    surfels = surfel_map.surfels(min_points=5)
    if not len(surfels):
        parser.error(f'{args.map}: no surfel has 5 points')
    low, high = surfels.position.min(axis=0)[:2], surfels.position.max(axis=0)[:2]
    limits = GridConfig(
        size_m=float(max(high - low)) + 2.0 * surfel_map.voxel_size_m,
        max_slope_deg=args.max_slope,
        max_step_m=args.max_step,
    )
    grid = traversability(surfels, surfel_map.voxel_size_m, (low + high) / 2.0, limits)
    write(grid, args.output)

    seen = grid.cost >= 0
    print(
        f'{grid.cost.shape[1]} x {grid.cost.shape[0]} cells of {grid.resolution_m:g} m: '
        f'{np.mean(grid.cost[seen] < 50):.0%} of the ground seen costs less than half, '
        f'{np.mean(grid.cost[seen] == 100):.0%} are obstacles'
    )


def write(grid: CostGrid, output: Path) -> None:
    """Write an image, its first row the greatest y, and its position."""
    image = np.where(grid.cost < 0, UNKNOWN, grid.cost.astype(np.int16)).astype(np.uint8)[::-1]
    header = f'P5 {image.shape[1]} {image.shape[0]} 255\n'
    output.with_suffix('.pgm').write_bytes(header.encode() + image.tobytes())
    output.with_suffix('.yaml').write_text(
        f'image: {output.with_suffix(".pgm").name}\n'
        'mode: raw\n'
        f'resolution: {grid.resolution_m}\n'
        f'origin: [{grid.origin[0]}, {grid.origin[1]}, 0.0]\n'
        'negate: 0\n'
        'occupied_thresh: 0.65\n'
        'free_thresh: 0.25\n',
        encoding='utf-8',
    )


if __name__ == '__main__':
    main()
