# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reading of YAML files, in time and memory bounded by their size.

A YAML alias (``*name``) repeats an anchored node (``&name``). A few lines of nested aliases expand
to a tree that no memory holds, so an alias inside of an anchored node is refused, and aliases
count as the nodes that they expand to. Nesting deeper than any setting, which would exhaust the
recursion of the parser, is refused too, and numbers of thousands of digits: those of base 60
(``1:1:1``) take time by the square of their length. Only regular files of at most 1 MiB are read.

A key twice is refused: PyYAML would drop the first in silence. Numbers such as 1e-2, which are
text to YAML 1.1 and so to PyYAML, are numbers, as they are to the parameter files of ROS.

Alone in its module because chains of filters and bags are read by it too, not only settings.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
import re
from typing import Any

from surfel_mapper.budget import read_small_file

MAX_DEPTH = 50

MAX_NODES = 20_000
"""Limit of the nodes of a file, and of those that its aliases expand to; settings have 600, and a
node takes 10 us."""

MAX_NUMBER = 4300
"""Limit of the length of a number, that of Python."""


NUMBER = re.compile(r'[-+.0-9]')
"""First character of a number."""

EXPONENT = re.compile(r'[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$')
"""Number with an exponent; YAML 1.1 demands a point and the sign of the exponent."""


def read_yaml(path: str | Path, *, as_text: bool = False, max_nodes: int = MAX_NODES) -> Any:
    """
    Return the content of a YAML file.

    Parameters
    ----------
    path : str or Path
        The file.
    as_text : bool
        Leave every scalar as text.
    max_nodes : int
        Limit of the nodes, and of those that aliases expand to.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it is not a regular file of at most 1 MiB, not YAML, is nested too deeply, has too many
        nodes, with those that aliases expand to, a number of too many digits, or a key twice
        (but as text, where the last counts).

    """
    return parse_yaml(read_small_file(path).decode(), as_text=as_text, max_nodes=max_nodes)


def parse_yaml(text: str, *, as_text: bool = False, max_nodes: int = MAX_NODES) -> Any:
    """Return the content of a YAML text; raises ValueError as read_yaml does."""
    import yaml

    # by libyaml, if PyYAML was built with it: 1 us a token instead of 10
    base = getattr(yaml, 'CBaseLoader', yaml.BaseLoader)
    try:
        events = checked_events(yaml.parse(text, base), max_nodes, as_text=as_text)
        if as_text:
            return text_document(events)  # of chains, where the last of two keys counts
        for _ in distinct_keys(events):
            pass
        return yaml.load(text, value_loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)))
    except yaml.MarkedYAMLError as error:
        # without the line itself: a caller may pass a path whose content is not theirs to read
        raise ValueError(f'{error.problem or error.context}{place(error.problem_mark)}') from error
    except yaml.YAMLError as error:
        raise ValueError('characters that YAML does not allow') from error
    except ValueError:
        raise
    except Exception as error:  # PyYAML's for a tag whose value is none of it: !!bool maybe
        raise ValueError(f'a value that its tag does not allow: {error!r}') from error


@cache
def value_loader(safe: Any) -> Any:
    """Return a safe loader of PyYAML, with 1e-2 as a number."""

    class Loader(safe):  # type: ignore[misc]
        pass

    Loader.add_implicit_resolver('tag:yaml.org,2002:float', EXPONENT, list('-+.0123456789'))
    return Loader


def text_document(events: Iterator[Any]) -> Any:
    """Return the only document of YAML, scalars as text; twice as fast as PyYAML's BaseLoader."""
    import yaml

    found, num_documents = None, 0
    anchors: dict[str, Any] = {}
    for event in events:
        if isinstance(event, yaml.DocumentStartEvent):
            num_documents += 1
        elif isinstance(event, yaml.NodeEvent):
            found = text_value(event, events, anchors)
    if num_documents > 1:
        raise ValueError('more than one document')
    return found


def text_value(event: Any, events: Iterator[Any], anchors: dict[str, Any]) -> Any:
    """Return the value that begins with an event; checked events nest at most MAX_DEPTH."""
    import yaml

    if isinstance(event, yaml.AliasEvent):
        if event.anchor not in anchors:
            raise ValueError(f'an unknown alias{place(event.start_mark)}')
        return anchors[event.anchor]
    value: Any = event.value if isinstance(event, yaml.ScalarEvent) else []
    if isinstance(event, yaml.CollectionStartEvent):
        while not isinstance(item := next(events), yaml.CollectionEndEvent):
            value.append(text_value(item, events, anchors))
    if isinstance(event, yaml.MappingStartEvent):
        if not all(isinstance(key, str) for key in value[::2]):
            raise ValueError(f'a key that is no text{place(event.start_mark)}')
        value = dict(zip(value[::2], value[1::2], strict=True))
    if event.anchor is not None:
        anchors[event.anchor] = value
    return value


def checked_events(events: Iterable[Any], max_nodes: int, *, as_text: bool) -> Iterator[Any]:
    """Yield events; ValueError for too many nodes, nested too deeply, or too long numbers."""
    import yaml

    open_nodes: list[tuple[str | None, int]] = []  # anchor, and number of the first node inside
    sizes: dict[str, int] = {}
    num_nodes = expanded = 0
    for event in events:
        if isinstance(event, yaml.AliasEvent):
            if any(anchor is not None for anchor, _ in open_nodes):
                raise ValueError(f'an alias inside of an anchored node{place(event.start_mark)}')
            expanded += sizes.get(event.anchor, 1)
            if expanded > max_nodes:
                raise ValueError(
                    f'aliases that expand to over {max_nodes} nodes{place(event.start_mark)}'
                )
        elif isinstance(event, yaml.NodeEvent):
            num_nodes += 1
            if num_nodes > max_nodes:
                raise ValueError(f'over {max_nodes} nodes{place(event.start_mark)}')
            if isinstance(event, yaml.CollectionStartEvent):
                open_nodes.append((event.anchor, num_nodes))
            elif not as_text and len(event.value) > MAX_NUMBER and NUMBER.match(event.value):
                raise ValueError(f'over {MAX_NUMBER} digits{place(event.start_mark)}')
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, first = open_nodes.pop()
            if anchor is not None:
                sizes[anchor] = num_nodes - first + 1
        if len(open_nodes) > MAX_DEPTH:
            raise ValueError(f'nested deeper than {MAX_DEPTH}{place(event.start_mark)}')
        yield event


@dataclass(slots=True)
class OpenMapping:
    """
    Keys of a mapping while its events are read.

    Attributes
    ----------
    prefix : str
        The keys that lead to it, each followed by a point.
    lines : dict of str to int
        Line of each key with its prefix; shared with the mappings inside.
    key : str, optional
        The key whose value comes next; None if a key comes next.

    """

    prefix: str = ''
    lines: dict[str, int] = field(default_factory=dict)
    key: str | None = None


def distinct_keys(events: Iterable[Any]) -> Iterator[Any]:
    """Yield events; ValueError for a key twice, also once as ``a.b`` and once as b in a."""
    import yaml

    nodes: list[OpenMapping | None] = []  # None: a list
    for event in events:
        if isinstance(event, yaml.CollectionEndEvent):
            nodes.pop()
        elif isinstance(event, yaml.NodeEvent):
            around, inside = nodes[-1] if nodes else None, OpenMapping()
            if around is not None and around.key is None:
                around.key = event.value if isinstance(event, yaml.ScalarEvent) else ''
                if around.key:
                    note_key(around, event.start_mark)
            elif around is not None:
                inside = OpenMapping(f'{around.prefix}{around.key}.', around.lines)
                around.key = None
            if isinstance(event, yaml.CollectionStartEvent):
                nodes.append(inside if isinstance(event, yaml.MappingStartEvent) else None)
        yield event


def note_key(mapping: OpenMapping, mark: Any) -> None:
    """Note the line of the key of a mapping; ValueError if it has been noted before."""
    name = f'{mapping.prefix}{mapping.key}'
    if name in mapping.lines:
        raise ValueError(
            f'{name}: twice, in line {mapping.lines[name]} and line {mark.line + 1}, expected once'
        )
    mapping.lines[name] = mark.line + 1


def place(mark: Any) -> str:
    """Return a position in a file as words."""
    return f' in line {mark.line + 1}, column {mark.column + 1}' if mark else ''
