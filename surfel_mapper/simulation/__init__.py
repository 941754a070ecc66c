# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A lidar driving through an analytic world: scans, poses and bags with known truth.

    simulation = Simulation(World.street(seed=1, length_m=50.0), Lidar(), num_scans=10)
    simulation.scans()                          the scans, with the true surface of every point
    simulation.drive.T_odom_sensor(stamp_ns)    true pose of the sensor
    simulation.world.normal_at(positions)       true normals; the world's frame is odom
    record(simulation, 'street')                write it as a bag
    load_simulation('street')                   the simulation that a bag was recorded from
"""

from surfel_mapper.simulation.drive import Drive, Simulation
from surfel_mapper.simulation.lidar import Lidar
from surfel_mapper.simulation.primitives import Primitive
from surfel_mapper.simulation.recording import load_simulation, record
from surfel_mapper.simulation.world import World

__all__ = [
    'Drive',
    'Lidar',
    'Primitive',
    'Simulation',
    'World',
    'load_simulation',
    'record',
]
