# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Chain: filters applied one after another, and a report of what each removed.

A chain is written as libpointmatcher writes it, a YAML list:

    - RemoveNaNDataPointsFilter              a name: all parameters at their defaults
    - VoxelGridDataPointsFilter:             or one name with parameters below it
        vSizeX: 0.5
    - range_limit: {min_m: 0.5}              our names and libpointmatcher's can be mixed

Every scalar is read as text and cast by its parameter, as libpointmatcher does. If a key is
repeated, the last one counts, as there.

A chain may be part of a larger file, as in configurations of ICP: ``FILE#key`` takes the list
under a key of the top level, ``FILE#key.key`` one further down.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import contextlib
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.compilation import clock
from surfel_mapper.config import near, parse_yaml, read_yaml, settings_of
from surfel_mapper.config.settings import checked
from surfel_mapper.errors import ConfigError, FilterError
from surfel_mapper.filters.base import as_scan, Filter, finite, FiniteFilter
from surfel_mapper.filters.columns import (
    DENSITIES,
    EIGEN_VALUES,
    EIGEN_VECTORS,
    INCIDENCE_ANGLES,
    NORMALS,
    OBSERVATION_DIRECTIONS,
)
from surfel_mapper.filters.registry import find
from surfel_mapper.scan import Scan


@dataclass(frozen=True, slots=True)
class Step:
    """Points and time of one filter of a chain on one scan."""

    name: str
    """Place in the chain and name: 2 voxel_grid."""

    points_in: int
    points_out: int
    milliseconds: float
    not_finite: int = 0
    """Points dropped because a coordinate is nan or infinite."""


class Chain:
    """
    Filters that are applied to a scan one after another.

    Parameters
    ----------
    filters : iterable of Filter
        In order; an empty chain returns every scan unchanged.

    """

    def __init__(self, filters: Iterable[Filter] = ()) -> None:
        self.filters = tuple(filters)
        self.names = tuple(
            f'{number} {filter_.name or type(filter_).__name__}'
            for number, filter_ in enumerate(self.filters, start=1)
        )

    @classmethod
    def from_list(cls, items: Any, where: str = 'filters') -> Chain:
        """
        Return the chain described by a list with the structure of the YAML.

        Parameters
        ----------
        items : list of (str, or mapping of one str to a mapping), or None
            Names of filters, with or without parameters.
        where : str
            What the errors begin with.

        Raises
        ------
        ConfigError
            If the list has another structure, or a filter, parameter or value is refused.

        """
        if items in (None, ''):
            return cls()
        if not isinstance(items, (list, tuple)):
            raise ConfigError(
                f'{where}: a {type(items).__name__}, expected a list of filters, '
                'each item a name or `name: {parameters}`'
            )
        return cls(made(item, f'{where}: filter {i}') for i, item in enumerate(items, start=1))

    @classmethod
    def from_yaml(cls, text: str) -> Chain:
        """
        Return the chain that a YAML text describes.

        Raises
        ------
        ConfigError
            If it is not YAML, or holds no valid chain.

        """
        try:
            content = parse_yaml(text, as_text=True)
        except ValueError as error:
            raise ConfigError(f'filters: not YAML: {error}') from error
        return cls.from_list(content)

    @classmethod
    def load(cls, path: str | Path) -> Chain:
        """
        Return the chain in a YAML file.

        Parameters
        ----------
        path : str or Path
            The file; ``FILE#key.key`` is the list under a key of the file.

        Raises
        ------
        ConfigError
            If the file cannot be read, is not YAML, or holds no valid chain.

        """
        name, _, keys = str(path).partition('#')
        content = read(name)
        for key in filter(None, keys.split('.')):
            if not isinstance(content, Mapping) or key not in content:
                inside = ', '.join(content) if isinstance(content, Mapping) else 'none'
                raise ConfigError(f'{path}: no key {key!r} there; keys: {inside}')
            content = content[key]
        if isinstance(content, Mapping):
            lists = ' or '.join(f'{path}{"." if keys else "#"}{key}' for key in content)
            raise ConfigError(
                f'{path}: a mapping, expected a list of filters; '
                f'if one of its keys holds the list, write {lists}'
            )
        return cls.from_list(content, str(path))

    def to_list(self) -> list[dict[str, dict[str, Any]]]:
        """Return the chain as a list for ``from_list`` or JSON, with our names."""
        return [
            {
                filter_.name: {
                    declared.name: jsonable(getattr(filter_, declared.name))
                    for declared in settings_of(type(filter_))
                }
            }
            for filter_ in self.filters
        ]

    def __len__(self) -> int:
        """Return the number of filters."""
        return len(self.filters)

    def apply(self, scan: Scan | npt.ArrayLike) -> Scan:
        """Return the filtered scan; see run."""
        return self.run(scan)[0]

    def run(self, scan: Scan | npt.ArrayLike) -> tuple[Scan, tuple[Step, ...]]:
        """
        Return the filtered scan and a Step for every filter.

        Parameters
        ----------
        scan : Scan or (N, 3) array_like, m
            Points alone become a scan with stamp 0 and without columns.

        Raises
        ------
        FilterError
            If a filter refuses the scan; the message begins with its place and name.

        """
        scan = as_scan(scan)
        steps = []
        for name, filter_ in zip(self.names, self.filters, strict=True):
            start, points_in = clock(), len(scan)
            not_finite = 0
            try:
                if isinstance(filter_, FiniteFilter):
                    scan = finite(scan)
                    not_finite = points_in - len(scan)
                    scan = filter_.apply_finite(scan)
                else:
                    scan = filter_.apply(scan)
            except FilterError as error:
                raise FilterError(f'filter {name}: {error}') from error
            milliseconds = (clock() - start) * 1e3
            steps.append(Step(name, points_in, len(scan), milliseconds, not_finite))
        return scan, tuple(steps)

    def warm_up(self, dtype: npt.DTypeLike = np.float32) -> None:
        """Compile the kernels of this package's filters for points of a type."""
        scan = example(dtype)
        for filter_ in self.filters:
            if type(filter_).__module__.startswith('surfel_mapper.'):
                with contextlib.suppress(FilterError):  # needs a column that the example lacks
                    replace(filter_).apply(scan)  # a copy: a filter may count its scans


def example(dtype: npt.DTypeLike) -> Scan:
    """Return a small scan with the columns that some filters need."""
    rng = np.random.default_rng(0)
    points = np.asfortranarray(rng.uniform(-1.0, 1.0, (64, 3)).astype(dtype))
    ones = np.ones(len(points), dtype)
    return Scan(
        points=points,
        stamp_ns=0,
        frame_id='example',
        columns={
            NORMALS: points / np.sqrt((points**2).sum(axis=1, keepdims=True)),
            OBSERVATION_DIRECTIONS: -points,
            DENSITIES: ones,
            EIGEN_VALUES: np.abs(points),
            EIGEN_VECTORS: np.tile(np.eye(3, dtype=dtype).ravel(), (len(points), 1)),
            INCIDENCE_ANGLES: ones,
        },
        T_base_sensor=np.eye(4),
        T_map_sensor=np.eye(4),
    )


def jsonable(value: Any) -> Any:
    """Return the value of a parameter for JSON: infinity as text, tuples as lists."""
    if isinstance(value, tuple):
        return [jsonable(item) for item in value]
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def read(path: str) -> Any:
    """Return the content of a YAML file, every scalar as text."""
    try:
        return read_yaml(path, as_text=True)
    except OSError as error:
        raise ConfigError(f'{path}: cannot be read: {error.strerror}') from error
    except ValueError as error:
        raise ConfigError(f'{path}: not YAML: {error}') from error


def made(item: Any, where: str) -> Filter:
    """Return the filter that one item of a list describes."""
    name, args = item, None
    if isinstance(item, Mapping):
        if len(item) != 1:
            raise ConfigError(
                f'{where}: {len(item)} keys ({", ".join(map(str, item))}), expected one, the name '
                'of the filter; parameters have to be indented deeper than the name'
            )
        name, args = next(iter(item.items()))
    if not isinstance(name, str):
        raise ConfigError(f'{where}: {name!r}, expected the name of a filter')
    if args in (None, ''):
        args = {}
    if not isinstance(args, Mapping):
        raise ConfigError(f'{where}, {name}: {args!r}, expected parameters, each `name: value`')
    try:
        cls = find(name)
    except ConfigError as error:
        raise ConfigError(f'{where}: {error}') from error
    values = values_of(cls, args, f'{where}, {name}', libpointmatcher=name == cls.libpointmatcher)
    try:
        return cls(**values)
    except ConfigError as error:  # a condition on several parameters
        raise ConfigError(f'{where}: {error}') from error


def values_of(
    cls: type[Filter], args: Mapping[str, Any], where: str, *, libpointmatcher: bool
) -> dict[str, Any]:
    """
    Return the values of a filter's parameters from an item of a chain.

    Parameters
    ----------
    cls : type of Filter
        The filter.
    args : mapping of str
        Our names or libpointmatcher's to values of the right type, or to their text.
    where : str
        What the errors begin with.
    libpointmatcher : bool
        Whether libpointmatcher's defaults hold for parameters not given.

    Raises
    ------
    ConfigError
        If a name is unknown (with the nearest known one) or given twice, or a value is refused.

    """
    declared = settings_of(cls)
    by_name = {field.key: field for field in declared}
    by_name |= {field.libpointmatcher: field for field in declared if field.libpointmatcher}
    values = (
        {field.key: field.libpointmatcher_default for field in declared} if libpointmatcher else {}
    )
    named: dict[str, str] = {}
    for name, value in args.items():
        if name not in by_name:
            expected = ', '.join(by_name) or 'it has none'
            raise ConfigError(
                f'{where}: {name}: no such parameter{near(str(name), by_name)} ({expected})'
            )
        key = by_name[name].key
        first_name = named.setdefault(key, name)
        if first_name != name:
            raise ConfigError(f'{where}: {first_name} and {name} are one parameter, expected one')
        values[key] = checked(f'{where}: {name}', value, by_name[name], takes_text=True)
    return values
