# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A map of the last ten scans, in ten lines.

A lidar in a simulated street gives the scans here. Yours are (N, 3) arrays in metres and the
(4, 4) poses that they were taken at.

    python examples/ten_lines.py
"""

from collections import deque

from surfel_mapper import SurfelMap
from surfel_mapper.simulation import Lidar, Simulation, World

street = Simulation(World.street(length_m=60.0), Lidar(beams=32, columns=1024), num_scans=30)

surfel_map = SurfelMap(voxel_size_m=0.5)
window = deque()
for scan in street.scans():
    T_map_sensor = street.drive.T_odom_sensor(scan.stamp_ns)
    rotation, position = T_map_sensor[:3, :3], T_map_sensor[:3, 3]
    window.append(surfel_map.add(scan.points @ rotation.T + position, origin=position))
    if len(window) > 10:
        surfel_map.remove(window.popleft())  # the exact inverse of that add
surfels = surfel_map.surfels(min_points=5)
level = surfels.select(surfels.is_good & (surfels.normal[:, 2] > 0.9))

print(f'{len(surfels)} surfels, {len(level)} of them good and level')

# The map is that of the last ten scans alone, to the bit.
last_ten = SurfelMap(voxel_size_m=0.5)
for moments in window:
    last_ten.insert(moments)
print(f'equal to a map of these alone: {surfel_map.digest() == last_ten.digest()}')
