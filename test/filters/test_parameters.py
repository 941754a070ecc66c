# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of filters: values, texts and refusals."""

from __future__ import annotations

from dataclasses import dataclass
import math

import pytest

from surfel_mapper.config import plain, settings_of
from surfel_mapper.errors import ConfigError
from surfel_mapper.filters import parameter
from surfel_mapper.filters.base import Filter
from surfel_mapper.filters.chain import values_of


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample(Filter):
    """A filter with a parameter of every type."""

    whole: int = parameter(3, 'A whole number.', low=1, high=10, libpointmatcher='wholeNumber')
    real: float = parameter(0.5, 'A number.', low=0.0, libpointmatcher_default=0.25)
    flag: bool = parameter(True, 'A flag.')
    text: str = parameter('a', 'A text.', choices=('a', 'b'))
    free: str = parameter('', 'Any text.')
    numbers: tuple[float, ...] = parameter((), 'Numbers.', items=float, low=-5.0, high=5.0)


def read(**given):
    return Sample(**values_of(Sample, given, 'here', libpointmatcher=False))


@pytest.mark.parametrize(
    ('name', 'text', 'value'),
    [
        ('whole', '7', 7),
        ('real', '5e-1', 0.5),
        ('real', '1', 1.0),
        ('real', 'inf', math.inf),
        ('real', '.inf', math.inf),
        ('flag', '0', False),
        ('flag', '1', True),
        ('flag', 'false', False),
        ('text', 'b', 'b'),
        ('free', '12', '12'),
        ('numbers', '[2.2, 3.0, 4.1]', (2.2, 3.0, 4.1)),
        ('numbers', '1 2', (1.0, 2.0)),
        ('numbers', '', ()),
        ('numbers', ['1', '2.5'], (1.0, 2.5)),
        ('numbers', (1, -2.0), (1.0, -2.0)),
    ],
)
def test_a_text_is_read_as_the_type_of_its_parameter(name, text, value):
    found = getattr(read(**{name: text}), name)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ('name', 'value', 'expected'),
    [
        ('whole', '0', r'here: whole: 0, expected a value in \[1, 10\]'),
        ('whole', 11, r'whole: 11, expected a value in \[1, 10\]'),
        ('whole', '2.5', "whole: '2.5', expected a whole number"),
        ('whole', True, 'whole: True, expected a whole number'),
        ('real', '-1e-9', r'real: -1e-09, expected a value in \[0, inf\]'),
        ('real', 'nan', r'real: nan, expected a value in \[0, inf\]'),
        ('real', 'half', "real: 'half', expected a number"),
        ('flag', '2', "flag: '2', expected 0 or 1"),
        ('text', 'c', "text: 'c', expected one of a, b"),
        ('text', 1, 'text: 1, expected a str'),
        ('numbers', 3.0, 'numbers: 3.0, expected a list of numbers'),
        ('numbers', [9.0], r'numbers: 9, expected a value in \[-5, 5\]'),
        ('numbers', {'a': 1}, 'numbers: .*, expected a list of numbers'),
    ],
)
def test_another_type_or_a_value_out_of_bounds_is_refused_with_what_was_expected(
    name, value, expected
):
    with pytest.raises(ConfigError, match=expected):
        read(**{name: value})


def test_parameters_in_python_are_checked_like_chains():
    with pytest.raises(ConfigError, match=r'Sample: whole: 0, expected a value in \[1, 10\]'):
        Sample(whole=0)


def test_either_name_of_a_parameter_is_taken_but_not_both():
    assert read(wholeNumber='4') == read(whole=4) == Sample(whole=4)
    with pytest.raises(ConfigError, match='wholeNumber and whole are one parameter'):
        read(wholeNumber='4', whole='4')


def test_the_default_follows_the_name_of_the_filter():
    assert values_of(Sample, {}, 'here', libpointmatcher=True)['real'] == 0.25
    assert read().real == 0.5


def test_an_unknown_parameter_is_refused_with_the_nearest_and_all_names():
    with pytest.raises(ConfigError, match=r'here: wholeNumbr: no .*mean wholeNumber.*whole, '):
        read(wholeNumbr='4')


def test_a_parameter_says_its_type_and_what_it_allows():
    assert [(p.name, p.kind, p.allowed) for p in settings_of(Sample)] == [
        ('whole', 'int', '[1, 10]'),
        ('real', 'float', '[0, inf]'),
        ('flag', 'bool', ''),
        ('text', 'str', 'a, b'),
        ('free', 'str', ''),
        ('numbers', 'list of float', '[-5, 5]'),
    ]


def test_values_are_written_without_noise():
    assert [plain(v) for v in (True, 0.1, 1e-7, (1.0, 2.5), 'a', math.inf)] == [
        '1',
        '0.1',
        '1e-07',
        '[1, 2.5]',
        'a',
        'inf',
    ]
