# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Surfaces that are gone, objects that come, and the cap that colours and labels obey."""

from functools import cache

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.integrator import Integrator
from surfel_mapper.tsdf.point_integrator import PointIntegrator
from surfel_mapper.tsdf.queries import FREE, labels_at, OCCUPIED, sample, states
from test.tsdf.scenes import image_of, integrator, SMALL

PERIOD_NS = 10**8
PLACE = [[0.02, 0.02, 2.02]]
DEEP = [[0.02, 0.02, z] for z in (2.02, 2.12, 2.22)]
SIZES = dict(voxel_size_m=0.1, truncation_m=0.3)


@cache
def wall_at(depth_m):
    return image_of(SMALL, depth_m * SMALL.ray_length)


def seen_through(one, first, num):
    """Return the number of scans until the place of the wall is free, at most num."""
    for number in range(num):
        one.integrate(wall_at(4.0), np.eye(4), (first + number) * PERIOD_NS)
        if (states(one.blocks, DEEP) == FREE).all():
            return number + 1
    return num


@pytest.mark.parametrize('forget_s', [2.0, 5.0])
def test_a_wall_that_is_gone_becomes_free_in_time(forget_s):
    one = integrator(**SIZES, forget_s=forget_s)
    for number in range(300):
        one.integrate(wall_at(2.0), np.eye(4), number * PERIOD_NS)
    assert states(one.blocks, PLACE)[0] == OCCUPIED
    scans = seen_through(one, 300, 1000)
    assert 3 <= scans <= forget_s * 1e9 / PERIOD_NS


def test_without_forgetting_a_wall_stays_as_long_as_it_was_seen():
    one = integrator(**SIZES, forget_s=0.0)
    for number in range(300):
        one.integrate(wall_at(2.0), np.eye(4), number * PERIOD_NS)
    assert seen_through(one, 300, 60) == 60


@pytest.mark.parametrize('by_points', [False, True])
def test_voxels_of_a_label_keep_at_most_its_weight_and_fade_in_one_scan(by_points):
    caps = dict(semantics='single', max_weight_by_label=(7.0, 0.01, 8.0, 0.02))
    one = integrator(**SIZES, forget_s=0.0, **caps)
    points = SMALL.directions.reshape(-1, 3)
    points = points * (2.0 / points[:, 2:])
    sides = np.where(np.arange(80) < 40, 7, 0) * np.ones((60, 1), int)
    for _ in range(20):
        if by_points:
            PointIntegrator(one.blocks).integrate(points, np.eye(4), labels=sides.ravel())
        else:
            one.integrate(wall_at(2.0).with_images(label=sides), np.eye(4))
    rows = one.blocks.rows()
    weights, named = one.blocks.weight[rows], one.blocks.votes[rows, 0] - 1.0
    assert (named == 7).sum() > 500
    assert weights[named == 7].max() == np.float32(0.01)
    assert weights[named == 0].max() > 4.0  # 20 scans at 2 m: 20 / 2^2, less the fall beside
    if by_points:
        PointIntegrator(one.blocks).integrate(2.0 * points, np.eye(4))
    else:
        one.integrate(wall_at(4.0), np.eye(4))
    places = [[-0.45, 0.02, 2.02], [0.45, 0.02, 2.02]]
    assert states(one.blocks, places).tolist() == [FREE, OCCUPIED]


def test_a_wall_that_is_gone_becomes_free_point_by_point():
    blocks = BlockMap(TsdfConfig(**SIZES, forget_s=2.0))
    one, rays = PointIntegrator(blocks), SMALL.directions.reshape(-1, 3)
    for number in range(120):
        far = 2.0 if number < 100 else 4.0
        points = rays * (far / rays[:, 2:])
        one.integrate(points, np.eye(4), number * PERIOD_NS)
        if number == 99:
            assert states(blocks, PLACE)[0] == OCCUPIED
    assert sample(blocks, PLACE).distance[0] > 0.05


def test_an_object_in_space_that_was_free_for_long_appears_in_time():
    one = integrator(**SIZES, forget_s=2.0)
    for number in range(300):
        one.integrate(wall_at(4.0), np.eye(4), number * PERIOD_NS)
    one.integrate(wall_at(2.0), np.eye(4), 300 * PERIOD_NS)
    assert states(one.blocks, PLACE)[0] == FREE  # a single false measurement is no object
    for number in range(301, 320):
        one.integrate(wall_at(2.0), np.eye(4), number * PERIOD_NS)
    assert states(one.blocks, PLACE)[0] == OCCUPIED


@pytest.mark.parametrize('by_points', [False, True])
def test_fifty_blue_after_500_red_are_blue_at_a_cap_of_ten(by_points, monkeypatch):
    for room in ('measurements', 'point_integrator'):
        monkeypatch.setattr(f'surfel_mapper.tsdf.{room}.MAX_WEIGHT', 2.5)
    config = TsdfConfig(
        **SIZES,
        forget_s=0.0,
        color=True,
        semantics='single',
    )
    one = Integrator(BlockMap(config))
    points = wall_at(2.0).sensor.directions.reshape(-1, 3)[::37]
    points = points * (2.0 / points[:, 2:])
    for number in range(550):
        label, color = (0, (200, 0, 0)) if number < 500 else (1, (0, 0, 200))
        if by_points:
            content = np.full((len(points), 3), color, np.uint8), np.full(len(points), label)
            PointIntegrator(one.blocks).integrate(
                points, np.eye(4), colors=content[0], labels=content[1]
            )
        else:
            image = wall_at(2.0).with_images(
                color=np.full((60, 80, 3), color, np.uint8), label=np.full((60, 80), label)
            )
            one.integrate(image, np.eye(4))
    assert labels_at(one.blocks, PLACE)[0].tolist() == [1]
    row = one.blocks.find(np.floor(np.array(PLACE) / 0.8).astype(int))[0]
    color = one.blocks.color[row]
    seen = (color[3] > 0) & (one.blocks.distance[row] > -0.05)  # of full weight
    red, blue, weight = color[0, seen], color[2, seen], color[3, seen]
    # 200 (10 / 11)^50 red is left; more where a measurement weighs less than a tenth of the cap
    left = 200.0 * (10.0 / 11.0) ** 50
    assert red.max() < 4.0 * left
    assert by_points or red.min() > 0.2 * left
    assert blue.min() > 190.0
    assert weight.max() == 2.5
