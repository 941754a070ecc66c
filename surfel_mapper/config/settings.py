# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
How a setting is declared, and what checks its value.

A stage is a frozen dataclass whose fields are made by ``setting``; its name in files is that of
its class without Config, or what ``STAGE`` says.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import dataclasses
from dataclasses import dataclass, field
import difflib
import math
from typing import Any, ClassVar

from surfel_mapper.errors import ConfigError


def setting(
    default: Any,
    meaning: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    items: type = float,
    live: bool = False,
) -> Any:
    """
    Declare a setting: its default, what it means and which values it may have.

    Parameters
    ----------
    default : bool, int, float, str or tuple
        Also gives the type.
    meaning : str
        One sentence for ``ros2 param describe`` and the table of the README.
    low, high : float, optional
        Bounds, both allowed.
    choices : tuple of str
        The only values allowed, where given.
    items : type
        Of what the tuple is, where it is one: float or str.
    live : bool
        Whether a running node takes a new value.

    """
    metadata = {
        'meaning': meaning,
        'low': low,
        'high': high,
        'choices': choices,
        'items': items,
        'live': live,
    }
    return field(default=default, metadata=metadata)


class Stage:
    """Base of the stages: checks every setting against its declaration."""

    __slots__ = ()
    STAGE: ClassVar[str] = ''
    """Name of the stage where it is not that of the class: ``layers.tsdf``."""

    def __post_init__(self) -> None:
        """Check every value; a whole number becomes a float where a float is declared."""
        stage = stage_name(type(self))
        for declared in dataclasses.fields(self):  # type: ignore[arg-type]
            name = f'{stage}.{declared.name}'
            value = checked(name, getattr(self, declared.name), declared)
            object.__setattr__(self, declared.name, value)
        self.check(stage)

    def check(self, stage: str) -> None:
        """Check what concerns several settings of the stage."""


@dataclass(frozen=True, slots=True)
class Declaration:
    """One setting as declared: its full name, and what ``setting`` was told; stage may be ''."""

    name: str
    stage: str
    key: str
    default: Any
    meaning: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    items: type
    live: bool


def flatten(mapping: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the leaves of nested mappings with their dotted names."""
    if not isinstance(mapping, Mapping):
        raise ConfigError(f'a {type(mapping).__name__}, expected a mapping of settings')
    for name, value in mapping.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


def near(name: str, known: Mapping[str, Any] | list[str]) -> str:
    """Return '; did you mean ...?' for the known name most like this one, or nothing."""
    found = difflib.get_close_matches(name, list(known), n=1)
    return f'; did you mean {found[0]}?' if found else ''


def stage_name(cls: type[Stage]) -> str:
    """Return the name of a stage: WindowConfig is window, unless it says otherwise."""
    return cls.STAGE or cls.__name__.removesuffix('Config').lower()


def checked(name: str, value: Any, declared: dataclasses.Field[Any]) -> Any:
    """Return the value in the type of its declaration, or raise ConfigError."""
    expected, meta = declared.default, declared.metadata
    if isinstance(expected, tuple):
        return checked_items(name, value, meta['items'])
    if isinstance(expected, (bool, str)):
        if not isinstance(value, type(expected)):
            raise ConfigError(f'{name}: {value!r}, expected a {type(expected).__name__}')
    else:
        value = checked_number(name, value, type(expected))
        low = -math.inf if meta['low'] is None else meta['low']
        high = math.inf if meta['high'] is None else meta['high']
        if not low <= value <= high:
            raise ConfigError(f'{name}: {value}, expected a value in [{low:g}, {high:g}]')
    if meta['choices'] and value not in meta['choices']:
        expected_names = ', '.join(meta['choices'])
        raise ConfigError(
            f'{name}: {value!r}, expected one of {expected_names}'
            f'{near(str(value), list(meta["choices"]))}'
        )
    return value


def checked_items(name: str, value: Any, kind: type) -> tuple[Any, ...]:
    """Return a list as a tuple of numbers or of strings."""
    wanted = 'numbers' if kind is float else 'strings'
    if isinstance(value, str) or not hasattr(value, '__iter__'):
        raise ConfigError(f'{name}: {value!r}, expected a list of {wanted}')
    if kind is float:
        return tuple(checked_number(name, item, float) for item in value)
    for item in value:
        if not isinstance(item, str):
            raise ConfigError(f'{name}: {item!r} in the list, expected a list of {wanted}')
    return tuple(value)


def checked_number(name: str, value: Any, kind: type) -> Any:
    """Return a finite number of a type; a whole number may stand for a float."""
    whole = isinstance(value, int) and not isinstance(value, bool)
    if kind is float and (whole or isinstance(value, float)):
        if not math.isfinite(value):
            raise ConfigError(f'{name}: {value}, expected a finite number')
        return float(value)
    if kind is int and whole:
        return value
    wanted = 'a number' if kind is float else 'a whole number'
    raise ConfigError(f'{name}: {value!r}, expected {wanted}')
