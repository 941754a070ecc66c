# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
YAML files, read in time and memory that their size bounds.

A name may stand for what was written before (``&name``, ``*name``). A few lines of names that
stand for names make a tree that no memory holds, so an alias may not stand inside of what has a
name itself; and nothing is nested deeper than any setting is, which recursion would not survive.
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
        Leave every scalar the text that it is.

    Raises
    ------
    OSError
        If it cannot be read.
    ValueError
        If it is not YAML, nested too deeply, or aliases stand inside of what they may stand for.

    """
    import yaml

    text = Path(path).read_text(encoding='utf-8')
    try:
        check_nesting(text)
        return yaml.load(text, yaml.BaseLoader if as_text else yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        # without the line itself: whoever may name a file may not be allowed to read it
        raise ValueError(f'{error.problem or error.context}{place(error.problem_mark)}') from error
    except yaml.YAMLError as error:
        raise ValueError('characters that YAML does not allow') from error


def check_nesting(text: str) -> None:
    """Raise ValueError where YAML is nested too deeply, or aliases inside of what has a name."""
    import yaml

    are_named: list[bool] = []
    for event in yaml.parse(text, yaml.BaseLoader):
        if isinstance(event, yaml.AliasEvent) and any(are_named):
            raise ValueError(f'an alias inside of what has a name{place(event.start_mark)}')
        if isinstance(event, yaml.CollectionStartEvent):
            are_named.append(event.anchor is not None)
        elif isinstance(event, yaml.CollectionEndEvent):
            are_named.pop()
        if len(are_named) > MAX_DEPTH:
            raise ValueError(f'nested deeper than {MAX_DEPTH}{place(event.start_mark)}')


def place(mark: Any) -> str:
    """Return where in a file something is."""
    return f' in line {mark.line + 1}, column {mark.column + 1}' if mark else ''
