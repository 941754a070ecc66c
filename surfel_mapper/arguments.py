# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Checks of the arguments of public functions, and short texts of the records that they return.

Errors name argument, value and expectation. Callers catch ValueError, TypeError and the errors of
this package; NumPy, kernels and missing attributes raise others, or name variables that the caller
does not know.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

MAX_SQUARE_ERROR = 1e-2
"""Tolerance of the squared norm of a quaternion, that of tf2: 0.71 0.71 of launch files passes."""

MOST_LETTERS = 80
"""Limit of the text of a collection in a record, a line of a terminal."""


class Record:
    """A dataclass whose text has types and shapes of its arrays, and sizes of collections."""

    __slots__ = ()

    def __repr__(self) -> str:
        """Return all fields in one line."""
        named = ((field.name, getattr(self, field.name)) for field in fields(cast(Any, self)))
        texts = [f'{name}={sized(value)}' for name, value in named]
        return f'{type(self).__name__}({", ".join(texts)})'


def sized(value: object) -> str:
    """Return an array as its type and shape, a long collection as its size, others in full."""
    if isinstance(value, np.ndarray):
        return f'{value.dtype} {value.shape}'
    text = repr(value)
    if isinstance(value, (list, tuple, dict)) and len(text) > MOST_LETTERS:
        return f'{type(value).__name__} of {len(value)}'
    return text


def as_array(name: str, values: npt.ArrayLike) -> npt.NDArray[Any]:
    """
    Return values as an array; raise ValueError, with their name, if none can be made.

    Lists of unequal rows and tensors on a graphics card are refused. Masked values become nan:
    NumPy would return the values under the mask.
    """
    if type(values) is np.ndarray:  # the usual case, in a cold cache too
        return values
    if isinstance(values, np.ma.MaskedArray):
        kept: Any = values if values.dtype.kind == 'f' else values.astype(np.float64)
        return np.asarray(kept.filled(np.nan))
    try:
        return np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as error:
        is_list = isinstance(values, (list, tuple))
        cause = ' of unequal rows' if is_list else f' that is no array ({error})'
        raise ValueError(f'{name}: a {type(values).__name__}{cause}, expected numbers') from None


def as_numbers(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return values as float64; raise ValueError, with their name, if they are not numbers."""
    array = as_array(name, values)
    if array.dtype == np.float64:
        return array
    try:
        if array.dtype.kind in 'cmMSUV':  # dates would become their number of ticks
            raise TypeError
        with np.errstate(over='ignore'):  # wider floats become infinite
            return np.asarray(array, np.float64)
    except (TypeError, ValueError, OverflowError):
        shown = repr(values) if isinstance(values, str) else f'a {type(values).__name__}'
        if isinstance(values, np.ndarray):
            shown = sized(array)
        raise ValueError(f'{name}: {shown}, expected numbers') from None


def as_real(name: str, value: object) -> float:
    """Return a number, of any type of numbers but bool; raise TypeError for others."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.number)):
        shown = f'a {type(value).__name__}' if isinstance(value, np.ndarray) else f'{value!r:.60}'
        raise TypeError(f'{name}: {shown}, expected a number')
    return float(as_numbers(name, value))


def as_whole(name: str, value: object) -> int:
    """Return a whole number of int64; TypeError for others, also bool, ValueError beyond it."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        shown = f'a {type(value).__name__}' if isinstance(value, np.ndarray) else repr(value)
        raise TypeError(f'{name}: {shown}, expected a whole number')
    if not -(2**63) <= value < 2**63:
        bits = int(value).bit_length()
        raise ValueError(f'{name}: a number of {bits} bits, expected at most 63 and a sign')
    return int(value)


def check_rows(name: str, rows: object) -> None:
    """Raise IndexError if rows are neither a slice nor a mask or indices in one dimension."""
    if isinstance(rows, slice):
        return
    array = as_array(name, rows)  # type: ignore[arg-type]
    if array.ndim != 1 or (array.size and array.dtype.kind not in 'iub'):
        raise IndexError(
            f'{name}: {array.dtype} {array.shape}, expected a slice, a mask or row indices'
        )


def made_array(array: npt.NDArray[Any], dtype: Any, copy: bool | None) -> npt.NDArray[Any]:
    """Return an array that was computed for np.asarray; raise ValueError if no copy may be."""
    if copy is False:
        raise ValueError('the array is computed, so that it cannot be had without a copy')
    return array if dtype is None else array.astype(dtype)


def as_path(path: object, name: str = 'path') -> Path:
    """Return a path; raise TypeError, with its name, for anything but text and paths."""
    if not isinstance(path, (str, Path)):
        raise TypeError(f'{name}: {path!r:.60}, expected a str or Path')
    return Path(path)


def check_kind(name: str, value: object, *kinds: type, hint: str = '') -> None:
    """
    Raise TypeError unless a value is an instance of a class: one sentence with name and classes.

    Without it the first attribute that is missing would be named, in a module that the caller
    does not know.

    Parameters
    ----------
    name : str
        Name of the argument.
    value : object
        The argument.
    kinds : type
        The classes that are allowed.
    hint : str
        How to make one.

    """
    if not isinstance(value, kinds):
        names = ' or '.join(kind.__name__ for kind in kinds)
        raise TypeError(
            f'{name}: a {type(value).__name__}, expected a {names}{": " if hint else ""}{hint}'
        )


def is_unit(q_xyzw: Iterable[float], tolerance: float = MAX_SQUARE_ERROR) -> bool:
    """Return whether the squared norm of a quaternion is 1 within a tolerance."""
    return abs(sum(value * value for value in q_xyzw) - 1.0) <= tolerance
