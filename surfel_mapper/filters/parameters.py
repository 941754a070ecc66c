# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Parameters of filters: declared once with default, bounds and meaning, and read from any chain.

A parameter is a field of the filter's dataclass. It has our name, and for filters of
libpointmatcher the name that it has there too; a chain may use either. Values come from Python
or as text: libpointmatcher casts the text of its YAML, so that ``'0.5'``, ``5e-1`` and ``inf``
are numbers there, while YAML itself takes the last two for text and ``010`` for eight.
"""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
from dataclasses import dataclass, field
import math
from typing import Any

from surfel_mapper.config import near
from surfel_mapper.errors import ConfigError

SAME = object()
"""Stands for no default of its own under libpointmatcher's name."""

BOOLEANS = {'true': True, 'false': False}


def parameter(
    default: Any,
    meaning: str,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
    items: type | None = None,
    theirs: str = '',
    their_default: Any = SAME,
) -> Any:
    """
    Declare a parameter of a filter: its default, what it means and which values it may have.

    Parameters
    ----------
    default : bool, int, float, str or tuple
        Also gives the type.
    meaning : str
        One sentence for ``surfel-mapper filters``.
    low, high : float
        Bounds of a number, or of each number of a tuple; both allowed. nan never is.
    choices : tuple of str
        The only texts allowed, where given.
    items : int, float or str
        Type of the items, where the default is a tuple.
    theirs : str
        Its name in libpointmatcher, where the filter is one of those.
    their_default : optional
        The default under libpointmatcher's name of the filter, where it differs.

    """
    metadata = {
        'meaning': meaning,
        'low': low,
        'high': high,
        'choices': choices,
        'items': items,
        'theirs': theirs,
        'their_default': default if their_default is SAME else their_default,
    }
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter as declared: its name and what ``parameter`` was told."""

    name: str
    default: Any
    meaning: str
    low: float
    high: float
    choices: tuple[str, ...]
    items: type | None
    theirs: str
    their_default: Any

    @property
    def kind(self) -> str:
        """The type in words."""
        if isinstance(self.default, tuple):
            assert self.items is not None
            return f'list of {self.items.__name__}'
        return type(self.default).__name__

    @property
    def allowed(self) -> str:
        """Which values it may have, in words; empty where its type says all."""
        if self.choices:
            return ', '.join(self.choices)
        bounded = self.low > -math.inf or self.high < math.inf
        numbers = isinstance(self.default, (int, float)) or self.items in (int, float)
        if isinstance(self.default, bool) or not numbers or not bounded:
            return ''
        return f'[{plain(self.low)}, {plain(self.high)}]'


def parameters_of(cls: type) -> list[Parameter]:
    """Return the parameters of a filter, in order; fields without a meaning are its own affair."""
    return [
        Parameter(declared.name, declared.default, **declared.metadata)
        for declared in dataclasses.fields(cls)
        if 'meaning' in declared.metadata
    ]


def values_of(cls: type, given: Mapping[str, Any], where: str, *, theirs: bool) -> dict[str, Any]:
    """
    Return the values of a filter's parameters from what a chain says.

    Parameters
    ----------
    cls : type
        The filter.
    given : mapping of str
        Our names or libpointmatcher's to values of the right type, or to their text.
    where : str
        What the errors begin with.
    theirs : bool
        Whether libpointmatcher's defaults hold for what is not given.

    Raises
    ------
    ConfigError
        If a name is unknown (with the nearest known one) or given twice, or a value is refused.

    """
    declared = parameters_of(cls)
    known = {p.name: p for p in declared} | {p.theirs: p for p in declared if p.theirs}
    values = {p.name: p.their_default for p in declared} if theirs else {}
    named: dict[str, str] = {}
    for name, value in given.items():
        if name not in known:
            expected = ', '.join(known) or 'it has none'
            raise ConfigError(
                f'{where}: {name}: no such parameter{near(str(name), known)} ({expected})'
            )
        other = named.setdefault(known[name].name, name)
        if other != name:
            raise ConfigError(f'{where}: {other} and {name} are one parameter, expected one')
        values[known[name].name] = cast(f'{where}: {name}', value, known[name])
    return values


def cast(name: str, value: Any, declared: Parameter) -> Any:
    """Return a value, or the value that a text stands for, in the declared type; or refuse it."""
    if not isinstance(declared.default, tuple):
        return cast_one(name, value, type(declared.default), declared)
    if isinstance(value, str):
        value = value.strip().removeprefix('[').removesuffix(']').replace(',', ' ').split()
    if not hasattr(value, '__iter__') or isinstance(value, Mapping):
        raise ConfigError(f'{name}: {value!r}, expected a {declared.kind}')
    assert declared.items is not None
    return tuple(cast_one(name, item, declared.items, declared) for item in value)


def cast_one(name: str, value: Any, kind: type, declared: Parameter) -> Any:
    """Return one value of a type; refuse another type, what is out of bounds, and nan."""
    if kind is str:
        return cast_text(name, value, declared)
    found = number(value, kind)
    if found is None:
        words = {bool: '0 or 1', int: 'a whole number', float: 'a number'}
        raise ConfigError(f'{name}: {value!r}, expected {words[kind]}')
    if kind is not bool and not declared.low <= found <= declared.high:  # nan is refused here
        raise ConfigError(
            f'{name}: {plain(found)}, expected a value in '
            f'[{plain(declared.low)}, {plain(declared.high)}]'
        )
    return found


def cast_text(name: str, value: Any, declared: Parameter) -> str:
    """Return a text; refuse what is none, or none of the choices."""
    if not isinstance(value, str):
        raise ConfigError(f'{name}: {value!r}, expected a text')
    if declared.choices and value not in declared.choices:
        choices = list(declared.choices)
        raise ConfigError(
            f'{name}: {value!r}, expected one of {declared.allowed}{near(value, choices)}'
        )
    return value


def number(value: Any, kind: type) -> bool | int | float | None:
    """Return a value or the number that a text stands for, None where it is none of its kind."""
    if isinstance(value, str):
        value = number_in(value, kind)
    if kind is bool:
        return bool(value) if isinstance(value, (bool, int)) and value in (0, 1) else None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    if kind is float:
        return float(value)
    return value if isinstance(value, int) else None


def number_in(text: str, kind: type) -> bool | int | float | None:
    """Return the number that a text stands for, as libpointmatcher and YAML write it."""
    text = text.strip().lower()
    if kind is bool and text in BOOLEANS:
        return BOOLEANS[text]
    if '_' in text:  # Python takes 1_000, nobody else does
        return None
    sign = text[:1] if text[:1] in '+-' else ''
    try:
        if kind is float:
            return float(sign + text[len(sign) :].removeprefix('.') if 'inf' in text else text)
        return int(text)
    except ValueError:
        return None


def plain(value: Any) -> str:
    """Return a value as a chain has it: numbers without noise, booleans as 0 and 1."""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, tuple):
        return f'[{", ".join(plain(item) for item in value)}]'
    return f'{value:.12g}' if isinstance(value, float) else str(value)
