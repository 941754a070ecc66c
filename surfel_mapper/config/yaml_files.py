# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reading of YAML files, in time and memory bounded by their size.

A YAML alias (``*name``) repeats an anchored node (``&name``). A few lines of nested aliases expand
to a tree that no memory holds, so an alias inside of an anchored node is refused, and aliases
count as the nodes that they expand to. Nesting deeper than any setting, which would exhaust the
recursion of the parser, is refused too. Only regular files of at most 1 MiB are read.

Alone in its module because chains of filters and bags are read by it too, not only settings.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surfel_mapper.budget import read_small_file

MAX_DEPTH = 50

MAX_EXPANDED = 100_000
"""Limit of the nodes that the aliases of a file expand to; a chain of filters has some hundred."""


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
        If it is not a regular file of at most 1 MiB, not YAML, is nested too deeply, or has
        aliases that expand to too much.

    """
    return parse_yaml(read_small_file(path).decode(), as_text=as_text)


def parse_yaml(text: str, *, as_text: bool = False) -> Any:
    """Return the content of a YAML text; raises ValueError as read_yaml does."""
    import yaml

    try:
        check_nesting(text)
        return yaml.load(text, yaml.BaseLoader if as_text else yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        # without the line itself: a caller may pass a path whose content is not theirs to read
        raise ValueError(f'{error.problem or error.context}{place(error.problem_mark)}') from error
    except yaml.YAMLError as error:
        raise ValueError('characters that YAML does not allow') from error


def check_nesting(text: str) -> None:
    """Raise ValueError if YAML is nested too deeply or has aliases that expand to too much."""
    import yaml

    open_nodes: list[tuple[str | None, int]] = []  # anchor, and number of the first node inside
    sizes: dict[str, int] = {}
    num_nodes = expanded = 0
    for event in yaml.parse(text, yaml.BaseLoader):
        if isinstance(event, yaml.AliasEvent):
            if any(anchor is not None for anchor, _ in open_nodes):
                raise ValueError(f'an alias inside of an anchored node{place(event.start_mark)}')
            expanded += sizes.get(event.anchor, 1)
            if expanded > MAX_EXPANDED:
                raise ValueError(
                    f'aliases that expand to over {MAX_EXPANDED} nodes{place(event.start_mark)}'
                )
        elif isinstance(event, yaml.NodeEvent):
            num_nodes += 1
            if isinstance(event, yaml.CollectionStartEvent):
                open_nodes.append((event.anchor, num_nodes))
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, first = open_nodes.pop()
            if anchor is not None:
                sizes[anchor] = num_nodes - first + 1
        if len(open_nodes) > MAX_DEPTH:
            raise ValueError(f'nested deeper than {MAX_DEPTH}{place(event.start_mark)}')


def place(mark: Any) -> str:
    """Return a position in a file as words."""
    return f' in line {mark.line + 1}, column {mark.column + 1}' if mark else ''
