# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters under libpointmatcher's names against its outputs on real scans.

The cases and their comparison are golden/filters.* and golden/check_filters.py in the folder of
test data. Cases small enough to be restated here run everywhere.
"""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location
import os
from pathlib import Path

import numpy as np
import pytest

from test.filters import libpointmatcher
from test.filters.examples import filter_of, scan_of

GOLDEN = Path(os.environ.get('SURFEL_MAPPER_TEST_DATA', '')) / 'golden'
SCRIPT = GOLDEN / 'check_filters.py'


@pytest.fixture(scope='module')
def checker():
    if not os.environ.get('SURFEL_MAPPER_TEST_DATA') or not SCRIPT.exists():
        pytest.skip('SURFEL_MAPPER_TEST_DATA holds no golden/check_filters.py')
    spec = spec_from_file_location('check_filters', SCRIPT)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Checker(GOLDEN)


@pytest.mark.parametrize('name', [*libpointmatcher.FILTERS, 'chain'])
def test_every_case_equals_libpointmatcher(checker, name):
    cases = [case for case in checker.about['cases'] if case['filter'] == name]
    assert cases
    faults = []
    for case in cases:
        if case['kind'] == 'exact' and not case['fault']:
            faults += [f'{case["name"]}: {fault}' for fault in checker.exact(case)[0]]
        elif case['kind'] == 'refused':
            _, found, _ = checker.run(case)
            faults += [f'{case["name"]}: not refused'] if found is not None else []
        elif case['kind'] == 'random':
            text = checker.chance(case)
            faults += [f'{case["name"]}: {text}'] if text.startswith(('DOUBT', 'refused')) else []
    assert faults == []


SQUARE = np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0], [0, 0, 0.5]])
"""Scatter 4 along x and y, 0.2 along z."""


@pytest.mark.parametrize(
    ('name', 'settings', 'divisor'),
    [
        ('SurfaceNormalDataPointsFilter', {'knn': 5}, 5.0),
        ('SamplingSurfaceNormalDataPointsFilter', {'knn': 5, 'ratio': 1}, 5.0),
        ('ElipsoidsDataPointsFilter', {'knn': 5, 'samplingMethod': 1}, 1.0),
        ('surface_normal', {'knn': 5}, 4.0),
        ('sampling_surface_normal', {'knn': 5, 'ratio': 1}, 4.0),
        ('ellipsoids', {'knn': 5, 'samplingMethod': 1}, 4.0),
    ],
)
def test_eigenvalues_are_divided_as_under_the_name(name, settings, divisor):
    found = filter_of(name, keepEigenValues=1, **settings).apply(scan_of(SQUARE))
    expected = np.tile([0.2, 4.0, 4.0], (len(found), 1)) / divisor
    np.testing.assert_allclose(found.columns['eigValues'], expected, rtol=1e-12)


def test_boxes_without_a_normal_are_dropped_under_libpointmatchers_name_only():
    line = np.outer(np.arange(4.0), [1.0, 2.0, 3.0])
    corner = [[100.0, 0, 0], [101.0, 0, 0], [100.0, 1, 0], [101.0, 1, 0]]
    scan = scan_of([*line, *corner], row=range(8))
    settings = {'knn': 4, 'ratio': 1.0}
    theirs = filter_of('SamplingSurfaceNormalDataPointsFilter', **settings).apply(scan)
    assert theirs.columns['row'].tolist() == [4, 5, 6, 7]
    assert len(filter_of('sampling_surface_normal', **settings).apply(scan)) == 8
    bare = filter_of('SamplingSurfaceNormalDataPointsFilter', **settings, keepNormals=0)
    assert len(bare.apply(scan)) == 8
