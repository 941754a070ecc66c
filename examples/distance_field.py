# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A distance field without a mapper: fuse scans, mesh them, and ask how far obstacles are.

    python examples/distance_field.py street.ply

A simulated lidar drives along a street. The mesh is written, and the distance from the lidar to
the nearest obstacle printed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from surfel_mapper import DistanceField
from surfel_mapper.config import TsdfConfig
from surfel_mapper.files.mesh_ply import write_mesh
from surfel_mapper.simulation import Lidar, Simulation, World


def main() -> None:
    """Fuse ten scans, write the mesh, and query the field."""
    parser = argparse.ArgumentParser(description=str(__doc__).strip().partition('\n')[0])
    parser.add_argument('mesh', type=Path, help='PLY file to write')
    path = parser.parse_args().mesh
    simulation = Simulation(World.street(seed=1, length_m=60.0), Lidar(beams=32, columns=720))
    field = DistanceField(TsdfConfig(voxel_size_m=0.2, max_range_m=20.0))
    for number in range(10):
        stamp_ns = simulation.stamp_ns(number)
        pose = simulation.drive.T_odom_sensor(stamp_ns)
        field.add(simulation.scan(number).points, pose, stamp_ns=stamp_ns)

    mesh = field.mesh()
    write_mesh(path, mesh)
    print(f'{len(mesh)} triangles of {len(field)} blocks')

    place = pose[:3, 3]
    near = field.esdf(max_m=3.0).sample([place])[0]
    print(f'nearest obstacle: {near:.3f} m')


if __name__ == '__main__':
    main()
