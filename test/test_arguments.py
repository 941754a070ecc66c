# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Numbers and objects that no argument of the public functions can hold are refused as such.

Integers of Python have no limit: 2^70 fails in a kernel, and 2^1025 when it becomes a float, with
an OverflowError or pages of compiler errors. Callers catch ValueError, TypeError and the errors of
this package.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from surfel_mapper import (
    Config,
    diff,
    DistanceField,
    estimate_normals,
    MapMirror,
    Mapper,
    replay,
    Scan,
    show,
    SlidingWindow,
    Surfel,
    SurfelMap,
)
from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import SurfelMapperError
from surfel_mapper.models import fit

POINTS = np.random.default_rng(0).uniform(-2.0, 2.0, (300, 3))


def surfel_map():
    made = SurfelMap(0.5)
    made.add(POINTS)
    return made


def field():
    made = DistanceField()
    made.add(POINTS, np.eye(4))
    return made


def test_a_tensor_on_a_graphics_card_is_refused_with_its_reason():
    class Tensor:
        def __array__(self, dtype=None, copy=None):
            raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu()")

    for call in (SurfelMap(0.5).add, estimate_normals, Surfel, DistanceField().sample):
        with pytest.raises(ValueError, match=r'a Tensor .*Use Tensor\.cpu\(\).*expected numbers'):
            call(Tensor())


def test_masked_points_are_left_out():
    """The values under the mask would be points otherwise."""
    masked = np.ma.masked_array(POINTS, np.zeros(POINTS.shape, bool))
    masked[7:50, 1] = np.ma.masked
    kept, found = SurfelMap(0.5), SurfelMap(0.5)
    kept.add(np.delete(POINTS, slice(7, 50), axis=0))
    moments = found.add(masked)
    assert found.digest() == kept.digest()
    assert moments.left_out == {'not_finite': 43}
    with pytest.raises(ValueError, match=r'MaskedArray, expected an array: points\.filled'):
        Scan(points=masked, stamp_ns=0, frame_id='lidar')


KINDS = {
    'map': lambda v: Config(map=v),
    'more': lambda v: Config(more=v),
    'a': lambda v: Config.from_mapping(v),
    'config': lambda v: DistanceField(v),
    'blocks': lambda v: DistanceField(blocks=v),
    'camera': lambda v: DistanceField().add_depth(np.ones((4, 4)), v, np.eye(4)),
    'path': lambda v: field().save(v),
    'path ': lambda v: DistanceField.load(v, TsdfConfig()),
    'config: ': lambda v: DistanceField.load('missing.npz', v),
    'columns': lambda v: MapMirror(0.5, v),
    'points': lambda v: MapMirror(0.5).replace(v),
    'points: ': lambda v: MapMirror(0.5).change(v),
    'scan': lambda v: Mapper().add_scan(v),
    'image': lambda v: Mapper().add_image(v),
    'region': lambda v: Mapper().clear_region(v),
    'surfel_map': lambda v: Mapper().restore(v, []),
    'scans': lambda v: Mapper().restore(SurfelMap(0.5), [v]),
    'config ': lambda v: Mapper().reconfigure(v),
    'times': lambda v: Scan(points=POINTS, stamp_ns=0, frame_id='a', times=v),
    'depth': lambda v: Scan(points=POINTS, stamp_ns=0, frame_id='a', depth=v),
    'surfel_map ': lambda v: SlidingWindow(v),
    'config  ': lambda v: SlidingWindow(SurfelMap(0.5), v),
    'scan ': lambda v: SlidingWindow(SurfelMap(0.5)).insert(v),
    'scans ': lambda v: SlidingWindow(SurfelMap(0.5)).restore(v),
    'scans  ': lambda v: SlidingWindow(SurfelMap(0.5)).move(v),
    'columns ': lambda v: SurfelMap(0.5, columns=v),
    'options': lambda v: replay('missing', options=v),
    'progress': lambda v: replay('missing', progress=v),
    'num_points': lambda v: Surfel.from_stats([0.0] * 3, [0.0] * 6, v),
    ' ScanMoments': lambda v: SurfelMap(0.5).insert(v),
    ' SurfelMap': lambda v: SurfelMap(0.5).merge(v),
    'diff': lambda v: diff(v, SurfelMap(0.5)),
    ' SurfelMap or Surfels': lambda v: show(v),
}
"""Calls with an argument of a class, by a name in the error."""


@pytest.mark.parametrize('name', KINDS)
def test_an_object_of_another_class_is_refused_by_name(name):
    for value in (3.5, object(), SimpleNamespace()):
        with pytest.raises((SurfelMapperError, TypeError, ValueError)) as refused:
            KINDS[name](value)
        assert name.strip(' :') in str(refused.value)
        assert 'expected' in str(refused.value)


def test_complex_numbers_are_refused():
    """Their imaginary part was left out, with a warning."""
    with pytest.raises(ValueError, match='origin: a list, expected numbers'):
        SurfelMap(0.5).reduce(POINTS, origin=[1j, 0.0, 0.0])


def test_records_are_one_line_with_the_shapes_of_their_arrays():
    model = fit(np.random.default_rng(0).uniform(-1.0, 1.0, (2000, 3)) * [1.0, 1.0, 0.0])
    plane = model.planes[0]
    assert repr(plane).startswith(
        f'Plane(id=0, num_points={plane.num_points}, mean=float64 (3,), '
    )
    assert 'labels=int32 (2000,)' in repr(model)
    assert max(len(repr(record)) for record in (model, plane, model.gaussians)) < 500
