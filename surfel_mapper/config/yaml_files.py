# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reading of YAML files, in time and memory bounded by their size.

A YAML alias (``*name``) repeats an anchored node (``&name``). A few lines of nested aliases expand
to a tree that no memory holds, so an alias inside of an anchored node is refused. So is nesting
deeper than any setting, which would exhaust the recursion of the parser.

Alone in its module because chains of filters and bags are read by it too, not only settings.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

MAX_DEPTH = 50


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
        If it is not YAML, is nested too deeply, or has an alias inside of an anchored node.

    """
    return parse_yaml(Path(path).read_text(encoding='utf-8'), as_text=as_text)


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
    """Raise ValueError if YAML is nested too deeply or has an alias inside of an anchored node."""
    import yaml

    are_named: list[bool] = []
    for event in yaml.parse(text, yaml.BaseLoader):
        if isinstance(event, yaml.AliasEvent) and any(are_named):
            raise ValueError(f'an alias inside of an anchored node{place(event.start_mark)}')
        if isinstance(event, yaml.CollectionStartEvent):
            are_named.append(event.anchor is not None)
        elif isinstance(event, yaml.CollectionEndEvent):
            are_named.pop()
        if len(are_named) > MAX_DEPTH:
            raise ValueError(f'nested deeper than {MAX_DEPTH}{place(event.start_mark)}')


def place(mark: Any) -> str:
    """Return a position in a file as words."""
    return f' in line {mark.line + 1}, column {mark.column + 1}' if mark else ''
