# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""World, primitives and street: refused values, true surfaces, files, determinism."""

import json

import numpy as np
import pytest

from surfel_mapper.errors import ConfigError, FileFormatError
from surfel_mapper.simulation import Primitive, World

BOX = Primitive(kind='box', size_m=(2.0, 4.0, 6.0), label='car', reflectivity=0.9)
POLE = Primitive(kind='cylinder', size_m=(0.1, 5.0), xyz=(5.0, 0.0, 0.0), reflectivity=0.2)
BALL = Primitive(kind='sphere', size_m=(1.0,), xyz=(-5.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ('changed', 'says'),
    [
        (dict(kind='cone'), "'cone', expected one of rectangle"),
        (dict(size_m=(1.0, 2.0)), 'expected x y z'),
        (dict(size_m=(1.0, 2.0, 0.0)), 'positive and finite'),
        (dict(xyz=(0.0, 0.0, float('inf'))), 'finite'),
        (dict(q_xyzw=(0.0, 0.0, 0.0, 2.0)), 'norm'),
        (dict(reflectivity=1.5), 'reflectivity: 1.5'),
    ],
)
def test_an_invalid_primitive_is_refused(changed, says):
    good = dict(kind='box', size_m=(1.0, 2.0, 3.0))
    with pytest.raises(ValueError, match=says):
        Primitive(**{**good, **changed})


def test_surfaces_have_a_primitive_and_reflectivity():
    world = World([BOX, POLE, BALL])
    surface, distance_m, normal = world.surface_at(
        [[0.9, 0.1, 0.2], [0.0, 0.0, -4.0], [5.2, 0.0, 1.0], [5.0, 0.02, 2.6], [-5.0, 0.0, 2.0]]
    )
    assert world.primitive_of(surface).tolist() == [0, 0, 1, 1, 2]
    assert world.reflectivity(surface).tolist() == [0.9, 0.9, 0.2, 0.2, 0.5]
    np.testing.assert_allclose(distance_m, [0.1, 1.0, 0.1, 0.1, 1.0], atol=1e-15)
    np.testing.assert_allclose(
        normal, [[1, 0, 0], [0, 0, -1], [1, 0, 0], [0, 0, 1], [0, 0, 1]], atol=1e-15
    )
    np.testing.assert_array_equal(world.normal_at([[-5.0, 0.0, 2.0]]), normal[4:])


def test_no_surface_is_of_no_primitive():
    none = np.array([-1])
    world = World([BOX])
    assert world.primitive_of(none).tolist() == [-1]
    assert np.isnan(world.reflectivity(none)).all()


def test_a_street_is_the_same_for_the_same_seed_and_another_for_another():
    street = World.street(seed=3, length_m=40.0)
    assert street.primitives == World.street(seed=3, length_m=40.0).primitives
    assert street.primitives != World.street(seed=4, length_m=40.0).primitives
    assert len(World.street(seed=3, length_m=300.0).primitives) > len(street.primitives)


def test_a_street_has_every_kind_and_nothing_flat_along_the_grid():
    street = World.street(seed=1, length_m=60.0)
    assert {p.kind for p in street.primitives} == {
        'rectangle',
        'box',
        'cylinder',
        'tube',
        'sphere',
    }
    labels = {'ground', 'building', 'pavement', 'car', 'pole', 'lamp', 'trunk', 'crown', 'bin'}
    assert labels <= {p.label for p in street.primitives}
    for primitive in street.primitives:
        if primitive.kind in ('rectangle', 'box'):
            axes = np.abs(primitive.T_world_primitive[:3, :3])
            assert axes.max() < np.cos(np.deg2rad(0.5)), primitive


@pytest.mark.parametrize(
    'arguments', [dict(seed=-1), dict(length_m=0.0), dict(length_m=-5.0), dict(length_m=np.nan)]
)
def test_an_invalid_street_is_refused(arguments):
    with pytest.raises(ConfigError, match=r'seed|length_m'):
        World.street(**arguments)


def test_a_world_read_from_its_file_casts_the_same_rays_to_the_last_bit(tmp_path):
    street = World.street(seed=2, length_m=30.0)
    street.save(tmp_path / 'world.json')
    again = World.load(tmp_path / 'world.json')
    rng = np.random.default_rng(0)
    ahead = rng.normal(size=(2000, 3))
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    origin = street.T_world_start @ [5.0, 0.0, 2.0, 1.0]

    for one, other in zip(
        street.raycast(origin[:3], ahead), again.raycast(origin[:3], ahead), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    assert again.primitives == street.primitives
    np.testing.assert_array_equal(again.T_world_start, street.T_world_start)


def damaged(**changes):
    content = {'format': 'surfel_mapper world 1', 'start': [0, 0, 0, 0, 0, 0, 1], 'primitives': []}
    return json.dumps({**content, **changes})


@pytest.mark.parametrize(
    ('text', 'says'),
    [
        ('{', 'Expecting'),
        (damaged(format='surfel_mapper world 99'), 'world 99'),
        ('{"format": "surfel_mapper world 1"}', 'primitives'),
        (damaged(primitives=[{'kind': 'box'}]), 'size_m'),
        (damaged(primitives=[{'kind': 'box', 'size_m': [1, 1, 1], 'wings': 2}]), 'wings'),
        (damaged(start=[0.0] * 7), 'norm'),
    ],
)
def test_a_file_that_holds_no_world_is_refused_by_name(text, says, tmp_path):
    file = tmp_path / 'world.json'
    file.write_text(text)
    with pytest.raises(FileFormatError, match=says) as refused:
        World.load(file)
    assert str(file) in str(refused.value)


def test_a_missing_file_is_refused_by_name(tmp_path):
    with pytest.raises(FileFormatError, match=r'no\.json: cannot be read'):
        World.load(tmp_path / 'no.json')
