# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Parts of a recording whose scans had no certain place: all scans together have one, or none."""

import numpy as np
import pytest

from surfel_mapper.alignment.registration import Registration
from surfel_mapper.bags.reader import BagReader
from surfel_mapper.config import Config
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.offline.summary import uncertain_text
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.map_part import LEAST_MATCHED, MapPart, Sighting
from surfel_mapper.pipeline.prepared import Prepared
from surfel_mapper.scan import Scan
from surfel_mapper.simulation import World
from test.pipeline.test_fast_turns import hall, LIDAR

CONFIG = Config.from_mapping({'pose.source': 'registration'})
TURNED = [(9.0 - 0.3 * k, 5.0, 150.0 + 3.0 * k) for k in range(6)]


def pose(x_m, y_m, heading_deg):
    half = np.radians(heading_deg) / 2.0
    return pose_matrix((x_m, y_m, 1.3), (0.0, 0.0, np.sin(half), np.cos(half)))


def points_at(world, T_world_sensor, number):
    points = LIDAR.scan(world, T_world_sensor, stamp_ns=0, number=number).points
    return np.asfortranarray(points[np.isfinite(points).all(axis=1)])


def map_of_walk(world):
    """Return the map of a walk along one side, at true poses."""
    surfel_map = SurfelMap(CONFIG.map.voxel_size_m)
    for k in range(6):
        T_map_sensor = pose(-9.0 + 0.5 * k, -6.0, 3.0 * k)
        points = points_at(world, T_map_sensor, k) @ T_map_sensor[:3, :3].T
        surfel_map.add(points + T_map_sensor[:3, 3], origin=T_map_sensor[:3, 3])
    return surfel_map


def part_of(world, poses):
    """Return a part of scans at poses, tracked on their own."""
    registration = Registration(CONFIG.registration, CONFIG.map.voxel_size_m)
    part = MapPart(registration, CONFIG, np.eye(4), (0.5, 0.1), 'lost')
    part.tracker.begin(10**8, np.zeros(6))
    for number, T_world_sensor in enumerate(poses, start=1):
        points = points_at(world, T_world_sensor, 100 + number)
        scan = Scan(points=points, stamp_ns=number * 10**8, frame_id='lidar')
        sighting = Sighting(
            prepared=Prepared(scan, scan, np.eye(4)),
            cells=registration.cells(points),
            stamp_ns=scan.stamp_ns,
            T_middle_body=np.eye(4),
            T_body_sensor=np.eye(4),
        )
        part.add(sighting)
    return part


@pytest.mark.parametrize('guess', [(-6.5, -6.0, 15.0), (8.0, 6.0, 20.0)], ids=('far', 'near'))
def test_a_part_is_placed_from_any_guess(guess):
    part = part_of(hall(), [pose(*xyh) for xyh in TURNED])
    T_map_part, _ = part.matched(map_of_walk(hall()), pose(*guess))
    np.testing.assert_allclose(T_map_part, pose(*TURNED[0]), atol=0.03)


def test_a_part_larger_than_the_map_is_placed_too():
    walk = [pose(-9.0 + 1.5 * k, -6.0, 20.0 * k) for k in range(8)]
    world = hall()
    small = SurfelMap(CONFIG.map.voxel_size_m)
    T_map_sensor = pose(-9.0, -6.0, 0.0)
    small.add(points_at(world, T_map_sensor, 0) @ T_map_sensor[:3, :3].T + T_map_sensor[:3, 3])
    T_map_part, _ = part_of(world, walk).matched(small, pose(-8.0, -6.0, 50.0))
    np.testing.assert_allclose(T_map_part, walk[0], atol=0.03)


def test_a_part_without_a_certain_place_is_not_placed():
    poses = [pose(*xyh) for xyh in TURNED]
    few = part_of(hall(), poses[: LEAST_MATCHED - 1])
    assert few.matched(map_of_walk(hall()), poses[0]) is None
    walls = World(hall().primitives[:6])  # half a turn about its middle makes no difference
    assert part_of(walls, poses).matched(map_of_walk(walls), poses[0]) is None
    street = World.street(seed=1, length_m=60.0)
    assert part_of(street, poses).matched(map_of_walk(hall()), poses[0]) is None


@pytest.mark.parametrize('closes_loops', [True, False])
def test_scans_of_a_narrow_view_are_joined_at_the_end_and_named(data_folder, closes_loops):
    settings = {'pose.source': 'registration', 'loops.enabled': closes_loops}
    mapper = Mapper(Config.from_mapping(settings))
    with BagReader(data_folder / 'data' / 'bags' / 'hall_os0_long') as reader:
        scans = [to_scan(reader.decode(message)) for message in reader.messages({'/points'})]
    stamps_ns = []
    for number, scan in enumerate(scans[:64:2], start=1):
        ahead = np.abs(np.arctan2(scan.points[:, 1], scan.points[:, 0])) < np.pi / 4.0
        points = np.asfortranarray(scan.points[ahead])
        mapper.add_scan(Scan(points=points, stamp_ns=number * 10**8, frame_id='lidar'))
        stamps_ns += [update.stamp_ns for update in mapper.insert_ready()]
    num_certain = len(stamps_ns)
    mapper.end_scans()
    stamps_ns += [update.stamp_ns for update in mapper.insert_ready()]
    mapper.finish()

    assert num_certain == 28
    text = uncertain_text(mapper.summary())
    if closes_loops:
        assert stamps_ns == [number * 10**8 for number in range(1, 33)]
        assert 'in 4 of 32 scans (2.900 to 3.200 s) only their separate map' in text
    else:
        assert len(stamps_ns) == 28
        assert mapper.counters.dropped == {'apart': 4}
