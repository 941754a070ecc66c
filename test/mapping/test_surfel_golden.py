# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfel against 53 golden programs of adding, removing and merging, whose exact results are known.

The inputs are float32 or float64 as stored; the results to reproduce (``ref_*``) were computed
exactly and rounded, their eigenvalues by an iterative solver. With ``rounding`` of the scatter's
entries as in surfel_promises.py, eigenvalues may differ by that (Weyl) and 4 EPS of the trace for
two solvers, planarity by 7 times that over the trace, a normal by 3 times that over the gap
e1 - e0 (Davis and Kahan). Of fewer than two points and of equal points the promises of Surfel
hold.
"""

import json

import numpy as np
import pytest

from surfel_mapper.mapping.surfel import Surfel
from test.mapping.surfel_promises import assert_normal, assert_promises, EPS, rounding, trace

pytestmark = pytest.mark.filterwarnings('error')


@pytest.fixture(scope='module')
def golden(data_folder):
    path = data_folder / 'golden' / 'surfel.json'
    if not path.exists():
        pytest.skip(f'{path} is not there')
    with np.load(path.with_suffix('.npz')) as arrays:
        return json.loads(path.read_text(encoding='utf-8')), dict(arrays)


class Program:
    """
    A run of a golden program.

    registers  name to Surfel
    largest    name to the largest trace of the scatter that went into it
    steps      number of times a surfel was changed so far
    reach      largest distance along an axis between points of one array, m
    """

    def __init__(self, arrays):
        self.arrays, self.registers, self.largest = arrays, {}, {}
        self.steps, self.reach = 0, 0.0

    def run(self, op):
        """Run an operation and update the bound of its rounding."""
        points = self.points(op) if 'array' in op else None
        surfel = self.result(op, points)
        inputs = [op[key] for key in ('reg', 'other', 'a', 'b') if key in op]
        came_from = [self.largest.get(register, 0.0) for register in inputs]
        self.registers[op['reg']] = surfel
        self.largest[op['reg']] = max([trace(surfel), *came_from])
        self.steps += len(points) if op['op'] == 'add_each' else 1

    def points(self, op):
        points = self.arrays[f'arrays/{op["array"]}']
        self.reach = max(self.reach, np.ptp(points, axis=0).max())
        return points[op['index']] if 'index' in op else points[op['start'] : op['stop']]

    def result(self, op, points):
        """Return the register of an operation after it."""
        surfel = self.registers.get(op['reg'])
        operand = self.registers[op['other']] if 'other' in op else points
        match op['op']:
            case 'new':
                surfel = Surfel()
            case 'ctor_point' | 'ctor_range':
                surfel = Surfel.from_points(points)
            case 'ctor_raw':
                surfel = Surfel.from_stats(op['sum'], op['sum_squares'], op['num_points'])
            case 'ctor_position_scatter':
                surfel = Surfel.from_position(op['position'], op['scatter'])
            case 'copy':
                surfel = operand.copy()
            case 'plus':
                surfel = self.registers[op['a']] + self.registers[op['b']]
            case 'minus':
                surfel = self.registers[op['a']] - self.registers[op['b']]
            case 'add_point' | 'add_batch' | 'add_surfel':
                surfel.add(operand)
            case 'add_each':
                for point in points:
                    surfel.add(point)
            case 'remove_point' | 'remove_batch' | 'remove_surfel':
                surfel.remove(operand)
            case 'iadd_point' | 'iadd_surfel':
                surfel += operand
            case 'isub_point' | 'isub_surfel':
                surfel -= operand
            case 'clear':
                surfel.clear()
            case unknown:
                raise ValueError(f'{unknown}: no such operation')
        return surfel


def assert_equals_reference(program, register, reference, normal_well_defined):
    surfel = program.registers[register]
    n = surfel.num_points
    assert n == reference['num_points']
    tolerance = EPS * np.abs(reference['mean']) + rounding(program.steps) * program.reach
    assert (np.abs(surfel.mean() - reference['mean']) <= tolerance).all()
    if n < 2:
        return

    e0, e1, e2 = reference['eigenvalues']
    size = e0 + e1 + e2
    entry = rounding(program.steps) * program.largest[register] / (n - 1)
    value = entry + 4 * EPS * size
    np.testing.assert_allclose(surfel.covariance(), reference['covariance'], rtol=0, atol=entry)
    np.testing.assert_allclose(surfel.eigenvalues(), [e0, e1, e2], rtol=0, atol=value)
    if size > 0.0:
        expected = pytest.approx(reference['planarity'], abs=7 * value / size)
        assert surfel.planarity() == expected
    if normal_well_defined:
        assert_normal(surfel.normal(), reference['normal'], 3 * value / (e1 - e0))


def check_snapshot(program, register, name, description, arrays):
    """Compare a register with its golden values; return whether exact ones exist."""
    surfel = program.registers[register]
    assert surfel.num_points == arrays[f'{name}/num_points']
    assert_promises(surfel)
    prefix = f'{name}/ref_'
    reference = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    if reference:
        well_defined = description['accuracy'][name].get('normal_well_defined', False)
        assert_equals_reference(program, register, reference, well_defined)
    return bool(reference)


def test_all_golden_programs_give_the_exact_values(golden):
    description, arrays = golden
    num_compared = 0
    for case in description['cases']:
        program = Program(arrays)
        for op in case['ops']:
            name = f'{case["name"]}/{op.get("label")}'
            if op['op'] == 'snapshot':
                try:
                    num_compared += check_snapshot(program, op['reg'], name, description, arrays)
                except AssertionError as error:
                    raise AssertionError(name) from error
            elif op['op'] == 'equal':
                # Two results that differ in float32 may be equal in float64.
                equal = program.registers[op['a']] == program.registers[op['b']]
                assert equal or not arrays[f'{name}/equal'], name
            else:
                program.run(op)

    assert len(description['cases']) == 53
    assert num_compared == 60


@pytest.mark.parametrize(
    'case', ['ctor_raw', 'ctor_raw_n1', 'position_scatter_n2', 'position_scatter_n200']
)
def test_golden_statistics_given_raw_are_kept(golden, case):
    description, arrays = golden
    program = Program(arrays)

    program.run(next(c['ops'][0] for c in description['cases'] if c['name'] == case))

    surfel = program.registers['a']
    np.testing.assert_array_equal(surfel.sum, arrays[f'{case}/out/sum'])
    np.testing.assert_array_equal(surfel.sum_squares, arrays[f'{case}/out/sum_squares'])
