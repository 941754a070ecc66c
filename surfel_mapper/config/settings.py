# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Typed settings: how one is declared, and how its value is checked.

The stages of the configuration and the filters of a chain are frozen dataclasses whose fields are
made by ``setting``. Both derive from ``Settings``, which checks every value when an instance is
made. They differ in one point. A stage takes the types of ROS parameters as they are. A filter
also takes text, because libpointmatcher casts the text of its YAML: ``'0.5'``, ``5e-1`` and
``inf`` are numbers there, while YAML itself takes the last two for text and ``010`` for eight.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import dataclasses
from dataclasses import dataclass, field
import difflib
from functools import cache
import math
from typing import Any, ClassVar

from surfel_mapper.errors import ConfigError

SAME = object()
"""Stands for a default that is the same in libpointmatcher."""

BOOLEANS = {'true': True, 'false': False}


def setting(
    default: Any,
    meaning: str,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[str, ...] = (),
    items: type = float,
    live: bool = False,
    libpointmatcher: str = '',
    libpointmatcher_default: Any = SAME,
) -> Any:
    """
    Declare a setting: its default, its meaning and the values it may have.

    Parameters
    ----------
    default : bool, int, float, str or tuple
        Also gives the type.
    meaning : str
        One sentence for ``ros2 param describe``, ``surfel-mapper filters`` and the docs.
    low, high : float
        Bounds of a number, or of each number of a tuple; both allowed. nan never is.
    choices : tuple of str
        The only texts allowed; empty: any text.
    items : int, float or str
        Type of the items of a tuple.
    live : bool
        Whether a running node takes a new value.
    libpointmatcher : str
        Name of a filter's parameter in libpointmatcher; empty if it has none there.
    libpointmatcher_default : optional
        The default under libpointmatcher's name of the filter, if it differs.

    """
    metadata = {
        'meaning': meaning,
        'low': low,
        'high': high,
        'choices': choices,
        'items': items,
        'live': live,
        'libpointmatcher': libpointmatcher,
        'libpointmatcher_default': default
        if libpointmatcher_default is SAME
        else libpointmatcher_default,
    }
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True)
class Declaration:
    """One setting as declared: its stage, its key within it, and the arguments of ``setting``."""

    stage: str
    """Stage of the configuration; empty for a setting of no stage and for those of filters."""

    key: str
    default: Any
    meaning: str
    low: float
    high: float
    choices: tuple[str, ...]
    items: type
    live: bool
    libpointmatcher: str
    libpointmatcher_default: Any

    @property
    def name(self) -> str:
        """Full name: ``stage.key``, or the key alone."""
        return f'{self.stage}.{self.key}' if self.stage else self.key

    @property
    def kind(self) -> str:
        """The type in words."""
        if isinstance(self.default, tuple):
            return f'list of {self.items.__name__}'
        return type(self.default).__name__

    @property
    def is_list(self) -> bool:
        """Whether the value is a tuple."""
        return isinstance(self.default, tuple)

    @property
    def is_number(self) -> bool:
        """Whether the value is one number."""
        return type(self.default) in (int, float)

    @property
    def allowed(self) -> str:
        """The choices or bounds in words; empty if the type says all."""
        if self.choices:
            return ', '.join(self.choices)
        is_bounded = self.low > -math.inf or self.high < math.inf
        return f'[{plain(self.low)}, {plain(self.high)}]' if is_bounded else ''


class Settings:
    """Base of stages and filters: checks every field against its declaration."""

    __slots__ = ()

    TAKES_TEXT: ClassVar[bool] = False
    """Whether text stands for a number, 0 and 1 for a flag, and numbers may be infinite."""

    def __post_init__(self) -> None:
        """Check every value and bring it into the declared type."""
        for declared in settings_of(type(self)):
            where = self.where(declared.key)
            value = getattr(self, declared.key)
            value = checked(where, value, declared, takes_text=self.TAKES_TEXT)
            object.__setattr__(self, declared.key, value)

    @classmethod
    def where(cls, key: str) -> str:
        """Return what errors about a setting begin with."""
        return key


class Stage(Settings):
    """Base of the stages of the configuration."""

    __slots__ = ()

    STAGE: ClassVar[str] = ''
    """Name of the stage if it is not that of the class: ``layers.tsdf``."""

    def __post_init__(self) -> None:
        """Check every value; a whole number becomes a float if a float is declared."""
        Settings.__post_init__(self)
        self.check(stage_name(type(self)))

    @classmethod
    def where(cls, key: str) -> str:
        """Return the full name of a setting."""
        return f'{stage_name(cls)}.{key}'

    def check(self, stage: str) -> None:
        """Check conditions on several settings of the stage; raise ConfigError."""


def stage_name(cls: type[Stage]) -> str:
    """Return the name of a stage: ``STAGE``, or that of the class, so WindowConfig is window."""
    return cls.STAGE or cls.__name__.removesuffix('Config').lower()


def settings_of(cls: Any, stage: str = '') -> tuple[Declaration, ...]:
    """Return the settings of a dataclass, in order; fields not made by ``setting`` are skipped."""
    return _settings_of(cls, stage)


@cache
def _settings_of(cls: Any, stage: str) -> tuple[Declaration, ...]:
    return tuple(
        Declaration(stage, field.name, field.default, **field.metadata)
        for field in dataclasses.fields(cls)
        if 'meaning' in field.metadata
    )


def flatten(mapping: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the leaves of nested mappings with their dotted names."""
    if not isinstance(mapping, Mapping):
        raise ConfigError(f'a {type(mapping).__name__}, expected a mapping of settings')
    for name, value in mapping.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


def near(name: str, names: Mapping[str, Any] | list[str]) -> str:
    """Return "; did you mean ...?" for the most similar name; empty if none is similar."""
    matches = difflib.get_close_matches(name, list(names), n=1)
    return f'; did you mean {matches[0]}?' if matches else ''


def checked(name: str, value: Any, declared: Declaration, *, takes_text: bool = False) -> Any:
    """
    Return a value in the type of its declaration.

    Parameters
    ----------
    name : str
        Name of the setting in errors.
    value : object
        The value given.
    declared : Declaration
        Type, bounds and choices.
    takes_text : bool
        Whether text stands for a number, 0 and 1 for a flag, and numbers may be infinite.

    Raises
    ------
    ConfigError
        If the value is of another type, out of bounds, none of the choices or nan.

    """
    if not isinstance(declared.default, tuple):
        return checked_item(name, value, type(declared.default), declared, takes_text)
    if takes_text and isinstance(value, str):
        value = value.strip().removeprefix('[').removesuffix(']').replace(',', ' ').split()
    if isinstance(value, (str, Mapping)) or not hasattr(value, '__iter__'):
        words = {float: 'numbers', int: 'whole numbers', str: 'strings'}
        raise ConfigError(f'{name}: {value!r}, expected a list of {words[declared.items]}')
    return tuple(checked_item(name, item, declared.items, declared, takes_text) for item in value)


def checked_item(
    name: str, value: Any, kind: type, declared: Declaration, takes_text: bool
) -> bool | int | float | str:
    """Return one value of a type; see checked."""
    if kind is str:
        return checked_text(name, value, declared)
    number = read_number(value, kind) if takes_text and isinstance(value, str) else value
    if kind is bool:
        if takes_text and type(number) is int and number in (0, 1):
            number = bool(number)
        if not isinstance(number, bool):
            raise ConfigError(
                f'{name}: {value!r}, expected {"0 or 1" if takes_text else "a bool"}'
            )
        return number
    if isinstance(number, bool) or not isinstance(number, (int, float) if kind is float else int):
        wanted = 'a number' if kind is float else 'a whole number'
        raise ConfigError(f'{name}: {value!r}, expected {wanted}')
    try:
        number = kind(number)
    except (OverflowError, ValueError) as error:  # of hundreds of digits; inf as a whole number
        raise ConfigError(f'{name}: a number out of the range of floats') from error
    if not takes_text and not math.isfinite(number):
        raise ConfigError(f'{name}: {number}, expected a finite number')
    if not declared.low <= number <= declared.high:  # false for nan
        bounds = f'[{plain(declared.low)}, {plain(declared.high)}]'
        raise ConfigError(f'{name}: {plain(number)}, expected a value in {bounds}')
    return number  # type: ignore[no-any-return]


def checked_text(name: str, value: Any, declared: Declaration) -> str:
    """Return a text that is one of the choices, if there are any; see checked."""
    if not isinstance(value, str):
        raise ConfigError(f'{name}: {value!r}, expected a str')
    if declared.choices and value not in declared.choices:
        raise ConfigError(
            f'{name}: {value!r}, expected one of {declared.allowed}'
            f'{near(value, list(declared.choices))}'
        )
    return value


def read_number(text: str, kind: type) -> bool | int | float | None:
    """Return the number in a text as libpointmatcher and YAML write it, None if there is none."""
    text = text.strip().lower()
    if kind is bool and text in BOOLEANS:
        return BOOLEANS[text]
    if '_' in text or not text.isascii():  # Python reads 1_000 and all digits of Unicode
        return None
    sign = text[:1] if text[:1] in '+-' else ''
    try:
        if kind is float:
            return float(sign + text[len(sign) :].removeprefix('.') if 'inf' in text else text)
        return int(text)
    except ValueError:
        return None


def plain(value: Any) -> str:
    """Return a value as a chain has it: floats to 12 digits, booleans as 0 and 1."""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, tuple):
        return f'[{", ".join(plain(item) for item in value)}]'
    return f'{value:.12g}' if isinstance(value, float) else str(value)
