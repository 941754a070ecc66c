# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Few beams are followed although single rings in voxels move with the sensor."""

import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.geometry import inverse
from surfel_mapper.pipeline import Mapper
from surfel_mapper.simulation import Lidar, World
from test.pipeline.scenarios import Scenario, street_course

STREET = World.street(seed=1, length_m=200.0)

NUM_SCANS = 10


@pytest.mark.parametrize(('beams', 'columns'), [(8, 1024), (8, 2048), (16, 1024)])
def test_a_street_is_followed_with_few_beams(beams, columns):
    lidar = Lidar(beams=beams, columns=columns, elevation_deg=(-15.0, 15.0), range_noise_m=0.02)
    scenario = Scenario(
        name='street',
        world=STREET,
        course=street_course(STREET, 5.0),
        lidar=lidar,
        num_scans=NUM_SCANS,
    )
    mapper = Mapper(Config.from_mapping({'pose.source': 'registration'}))
    errors_m, first = [], None
    for scan, pose in scenario.scans():
        first = pose if first is None else first
        mapper.add_scan(scan)
        way_m = (inverse(first) @ pose)[:3, 3]
        errors_m += [np.linalg.norm(u.T_map_sensor[:3, 3] - way_m) for u in mapper.insert_ready()]
    mapper.finish()

    assert len(errors_m) == NUM_SCANS
    assert max(errors_m) < 0.3  # of 4.5 m; without larger voxels 6 to 9 of 10 scans are lost
