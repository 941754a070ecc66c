# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Rays and nearest surfaces: against known distances, and against twins on random worlds."""

import numpy as np
import pytest

from surfel_mapper.simulation.primitives import Primitive
from surfel_mapper.simulation.world import World
from test.simulation.kernels.raycast_twin import cast_twin, distances_twin


def one(kind, *size, **where):
    return World([Primitive(kind=kind, size_m=size, **where)])


def first(world, origin, direction):
    """Return range, surface and normal of one ray."""
    range_m, surface, normal = world.raycast(origin, [direction])
    return range_m[0], surface[0], normal[0].tolist()


def random_world(seed, number=25):
    """Return primitives of every kind, anywhere and turned at random."""
    rng = np.random.default_rng(seed)
    primitives = []
    for index in range(number):
        kind, sizes = [
            ('rectangle', 2),
            ('box', 3),
            ('cylinder', 2),
            ('tube', 2),
            ('sphere', 1),
        ][index % 5]
        q = rng.normal(size=4)
        primitives.append(
            Primitive(
                kind=kind,
                size_m=tuple(rng.uniform(0.3, 4.0, sizes)),
                xyz=tuple(rng.uniform(-8.0, 8.0, 3)),
                q_xyzw=tuple(q / np.linalg.norm(q)),
            )
        )
    return World(primitives)


def random_rays(seed, number=250):
    rng = np.random.default_rng(seed)
    ahead = rng.normal(size=(number, 3))
    return rng.uniform(-9.0, 9.0, (number, 3)), ahead / np.linalg.norm(ahead, axis=1)[:, None]


@pytest.mark.parametrize('seed', range(4))
def test_a_ray_hits_what_the_twin_finds(seed):
    world = random_world(seed)
    origins, ahead = random_rays(100 + seed)

    range_m, surface, _ = world.raycast(origins, ahead)

    twin = [cast_twin(world, *ray) for ray in zip(origins, ahead, strict=True)]
    assert surface.tolist() == [found for _, found in twin]
    # numpy's roots of a grazing ray carry the square root of rounding
    np.testing.assert_allclose(range_m, [distance for distance, _ in twin], rtol=1e-9)
    assert 0.3 < np.isfinite(range_m).mean() < 1.0
    assert len(set(world.primitive_of(surface[surface >= 0]) % 5)) == 5  # every kind


@pytest.mark.parametrize('seed', range(4))
def test_the_nearest_surface_is_that_of_the_twin(seed):
    world = random_world(seed)
    places = np.random.default_rng(200 + seed).uniform(-12.0, 12.0, (250, 3))

    surface, distance_m, _ = world.surface_at(places)

    twin = [distances_twin(world, place) for place in places]
    np.testing.assert_allclose(
        distance_m, [min(distances.values()) for distances in twin], rtol=1e-12, atol=1e-12
    )
    # Beyond the edge of a solid two faces are equally near: either is an answer.
    of_surface = [distances[found] for distances, found in zip(twin, surface, strict=True)]
    np.testing.assert_allclose(of_surface, distance_m, rtol=1e-12, atol=1e-12)


def test_the_normal_is_how_the_distance_grows_outside_a_solid():
    world = random_world(5)
    rng = np.random.default_rng(6)
    places = rng.uniform(-8.0, 8.0, (3000, 3))
    _, distance_m, normal = world.surface_at(places)
    step = 1e-6

    outward = world.surface_at(places + step * normal)[1] - distance_m

    # along the outward normal the distance grows outside and falls inside, where a face is near
    straight = np.abs(np.abs(outward) - step) < 1e-9
    beyond_edges = np.abs(outward) < step * (1.0 - 1e-3)
    assert (straight | beyond_edges).all()
    assert straight.mean() > 0.4


def test_a_thin_pole_far_away_is_hit_to_the_last_digits():
    world = one('tube', 0.05, 8.0, xyz=(300.0, 400.0, 0.0))
    range_m, _, _ = first(world, [0.0, 0.0, 0.0], [0.6, 0.8, 0.0])
    assert range_m == pytest.approx(499.95, abs=1e-11)


def test_nothing_is_hit_beyond_the_range_asked_for():
    world = one('rectangle', 2.0, 2.0)
    ray = [0.0, 0.0, 5.0], [[0.0, 0.0, -1.0]]
    assert world.raycast(*ray, max_range_m=5.1)[1].tolist() == [0]
    range_m, surface, _ = world.raycast(*ray, max_range_m=4.9)
    assert (range_m.tolist(), surface.tolist()) == ([np.inf], [-1])


def test_a_ray_exactly_along_the_sides_of_bounding_boxes_is_no_exception():
    world = World(
        [Primitive(kind='box', size_m=(2.0, 2.0, 2.0), xyz=(x, 0.0, 0.0)) for x in (0.0, 4.0)]
    )
    origins = [[-5.0, 1.0, 0.0], [-5.0, 0.0, -1.0], [1.0, 5.0, 0.0]]
    ahead = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    range_m, _, _ = world.raycast(origins, ahead)
    assert range_m.tolist() == [4.0, 4.0, 4.0]


def test_positions_that_are_not_finite_have_no_surface():
    world = random_world(0)
    surface, distance_m, normal = world.surface_at([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 0]])
    assert surface.tolist()[:2] == [-1, -1]
    assert distance_m.tolist()[:2] == [np.inf, np.inf]
    assert np.isnan(normal[:2]).all()
    assert surface[2] >= 0


def test_an_empty_world_has_nothing():
    world = World([])
    range_m, surface, normal = world.raycast([0.0, 0.0, 0.0], [[1.0, 0.0, 0.0]])
    assert (range_m.tolist(), surface.tolist()) == ([np.inf], [-1])
    assert np.isnan(normal).all()
    assert world.surface_at([[0.0, 0.0, 0.0]])[0].tolist() == [-1]
