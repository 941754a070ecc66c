# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The registry: finds a filter by our name or by libpointmatcher's.

Filters of this folder are registered when one is first looked up; those of other packages by the
decorator, or by an entry point of the group ``surfel_mapper.filters`` that names the class. An
entry point is loaded only when its name is looked up, so that a broken package affects only chains
that use it.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
from importlib import import_module
from importlib.metadata import entry_points
import logging
from pathlib import Path
import pkgutil
import re
from typing import overload, TypeVar

from surfel_mapper.config import near
from surfel_mapper.errors import ConfigError
from surfel_mapper.filters.base import Filter, FiniteFilter

GROUP = 'surfel_mapper.filters'
"""Group of the entry points."""

F = TypeVar('F', bound=type[Filter])

_log = logging.getLogger(__name__)

_FILTERS: dict[str, type[Filter]] = {}
"""Every registered filter under each of its names."""


@overload
def register(cls: F) -> F: ...


@overload
def register(*, name: str = '', libpointmatcher: str = '') -> Callable[[F], F]: ...


def register(
    cls: F | None = None, *, name: str = '', libpointmatcher: str = ''
) -> F | Callable[[F], F]:
    """
    Register a filter; a decorator, above ``@dataclass``, with or without arguments.

    Parameters
    ----------
    cls : type of Filter
        A dataclass.
    name : str
        Name in a chain; by default that of the class, RangeLimit is range_limit.
    libpointmatcher : str
        Name in libpointmatcher, if it has this filter.

    Raises
    ------
    ConfigError
        If the class is no filter, implements neither method, or the name is taken.

    """
    if cls is None:
        return functools.partial(_register, name=name, libpointmatcher=libpointmatcher)
    return _register(cls, name=name, libpointmatcher=libpointmatcher)


def _register(cls: F, *, name: str, libpointmatcher: str) -> F:
    if not (isinstance(cls, type) and issubclass(cls, Filter)):
        raise ConfigError(f'{cls!r}: expected a class derived from surfel_mapper.filters.Filter')
    own = [base for base in cls.__mro__ if base not in (*FiniteFilter.__mro__, cls)] + [cls]
    if not any(name in vars(base) for base in own for name in ('keep', 'apply', 'apply_finite')):
        raise ConfigError(f'{cls.__name__}: a filter has to implement keep or apply')
    cls.name = name or re.sub(r'(?<=[a-z0-9])(?=[A-Z])', '_', cls.__name__).lower()
    cls.libpointmatcher = libpointmatcher
    for key in filter(None, (cls.name, libpointmatcher)):
        registered = _FILTERS.setdefault(key, cls)
        if (registered.__module__, registered.__qualname__) != (cls.__module__, cls.__qualname__):
            raise ConfigError(
                f'filter {key!r} of {cls.__module__}: {registered.__module__} has one of this name'
            )
        _FILTERS[key] = cls  # reloading a module replaces its filters
    return cls


@functools.cache
def load_built_in() -> None:
    """Register the filters of this folder."""
    for module in pkgutil.iter_modules([str(Path(__file__).parent)]):
        import_module(f'surfel_mapper.filters.{module.name}')


def built_in() -> list[type[Filter]]:
    """Return the filters of this package, sorted by name."""
    load_built_in()
    own = {cls for cls in _FILTERS.values() if cls.__module__.startswith(f'{GROUP}.')}
    return sorted(own, key=lambda cls: cls.name)


def find(name: str) -> type[Filter]:
    """
    Return the filter class of a name, ours or libpointmatcher's.

    Raises
    ------
    ConfigError
        If the name is unknown (with the nearest known one), or its entry point fails to load.

    """
    load_built_in()
    if name not in _FILTERS and not _load_entry_point(name):
        points = [point.name for point in entry_points(group=GROUP)]
        raise ConfigError(
            f'{name}: no such filter, `surfel-mapper filters` lists all'
            f'{near(name, [*_FILTERS, *points])}'
        )
    return _FILTERS[name]


def all_filters() -> list[type[Filter]]:
    """Return every filter, sorted by name; log a warning for entry points that fail to load."""
    load_built_in()
    for point in entry_points(group=GROUP):
        try:
            _load_entry_point(point.name)
        except ConfigError as error:
            _log.warning('%s', error)
    return sorted(set(_FILTERS.values()), key=lambda cls: cls.name)


def _load_entry_point(name: str) -> bool:
    """Register the class of an entry point; return whether there is one of this name."""
    for point in entry_points(group=GROUP, name=name):
        try:
            cls = point.load()
        except Exception as error:  # the code of another package may raise anything
            raise ConfigError(
                f'filter {name!r}: entry point {point.value} does not load: {error!r}'
            ) from error
        if name not in _FILTERS:
            _register(cls, name=name, libpointmatcher='')
        return True
    return False
