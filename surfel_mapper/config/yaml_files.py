# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reading of YAML files of at most 1 MiB by PyYAML.

A key twice is refused: PyYAML would drop the first in silence. Numbers such as 1e-2, which are
text to YAML 1.1 and so to PyYAML, are numbers, as they are to the parameter files of ROS.

Alone in its module because chains of filters and bags are read by it too, not only settings.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import count
from pathlib import Path
import re
from typing import Any

from surfel_mapper.budget import read_small_file

MAX_NODES = 500_000
"""Limit of the nodes of a file; settings have 600, 1 MiB of text at most as many."""

EXPONENT = re.compile(r'[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$')
"""Number with an exponent; YAML 1.1 demands a point and the sign of the exponent."""


def read_yaml(path: str | Path, *, as_text: bool = False) -> Any:
    """
    Return the content of a YAML file.

    Parameters
    ----------
    path : str or Path
        The file.
    as_text : bool
        Leave every scalar as text.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it is not a regular file of at most 1 MiB, not YAML, or has a key twice (but as text,
        where the last counts).

    """
    return parse_yaml(read_small_file(path).decode(), as_text=as_text)


def parse_yaml(text: str, *, as_text: bool = False) -> Any:
    """Return the content of a YAML text; raises ValueError as read_yaml does."""
    import yaml

    try:
        loader = loader_class(as_text=as_text)(text)
        node = loader.get_single_node()
        if node is None:
            return None
        check_size(node, count())
        if not as_text:  # of repeated keys in a chain the last counts, as to libpointmatcher
            check_keys(node, '', {})
        return loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        # without the line itself: a caller may pass a path whose content is not theirs to read
        problem = error.problem or error.context
        if 'cannot start any token' in str(problem):
            problem = f'{problem} (a tab? indent with spaces)'
        raise ValueError(f'{problem}{position(error.problem_mark)}') from error
    except yaml.YAMLError as error:
        raise ValueError('characters that YAML does not allow') from error
    except ValueError:
        raise
    except Exception as error:  # PyYAML's for !!bool maybe; RecursionError of an alias in itself
        raise ValueError(f'a value that cannot be read: {error!r:.200}') from error


@cache
def loader_class(*, as_text: bool) -> Any:
    """Return a loader of PyYAML: of texts, or of values with 1e-2 as a number."""
    import yaml

    # by libyaml, if PyYAML was built with it: 1 us a token instead of 10
    if as_text:
        return getattr(yaml, 'CBaseLoader', yaml.BaseLoader)

    class Loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):  # type: ignore[misc]
        pass

    Loader.add_implicit_resolver('tag:yaml.org,2002:float', EXPONENT, list('-+.0123456789'))
    return Loader


def check_size(node: Any, number: Iterator[int]) -> None:
    """
    Raise ValueError if there are too many nodes below one, by a counter.

    Aliases count as the nodes that they expand to, because settings are walked like that: a few
    lines can expand to a tree without end.
    """
    if next(number) > MAX_NODES:
        raise ValueError(f'over {MAX_NODES} nodes, with those that aliases expand to')
    for item in node.value if isinstance(node.value, list) else ():
        for child in item if isinstance(item, tuple) else (item,):
            check_size(child, number)


def check_keys(node: Any, prefix: str, lines: dict[str, int]) -> None:
    """Raise ValueError for a key twice in a mapping, also once as ``a.b`` and once as b in a."""
    import yaml

    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            check_keys(item, '', {})
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        name, line = f'{prefix}{key.value}', key.start_mark.line + 1
        if name in lines:
            raise ValueError(
                f'{name}: twice, in line {lines[name]} and line {line}, expected once'
            )
        lines[name] = line
        check_keys(value, f'{name}.', lines)


def position(mark: Any) -> str:
    """Return a position in a file as words."""
    return f' in line {mark.line + 1}, column {mark.column + 1}' if mark else ''
