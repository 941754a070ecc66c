# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The table of faults in docs/faults.md, made from the tests: ``python -m test.ros.fault_table``.

Each test of a fault states, where it stands, what happens, what is counted and what is lost; it
then holds the node to it.
"""

from __future__ import annotations

from collections.abc import Callable
import importlib
from pathlib import Path
from typing import NamedTuple

PAGE = Path(__file__).parents[2] / 'docs' / 'faults.md'
MODULES = ('test.ros.test_faults_input', 'test.ros.test_faults_files')
BEGIN, END = '<!-- from here on made from test/ros -->', '<!-- to here -->'


class Fault(NamedTuple):
    """A fault, and what comes of it."""

    name: str
    happens: str
    counted: str
    lost: str


FAULTS: list[Fault] = []


def fault(name: str, *, happens: str, counted: str, lost: str) -> Callable:
    """Mark a test as that of a fault."""
    FAULTS.append(Fault(name, happens, counted, lost))
    return lambda test: test


def table() -> str:
    """Return the table of all faults."""
    for module in MODULES:
        importlib.import_module(module)
    rows = ['| fault | what happens | counted as | lost |', '|---|---|---|---|']
    rows += [f'| {" | ".join(entry)} |' for entry in sorted(FAULTS)]
    return '\n'.join([BEGIN, *rows, END])


def page_with(rows: str) -> str:
    """Return the page with other rows."""
    text = PAGE.read_text(encoding='utf-8')
    before, _, rest = text.partition(BEGIN)
    return before + rows + rest.partition(END)[2]


if __name__ == '__main__':
    from test.ros import fault_table  # where the tests have entered theirs

    PAGE.write_text(page_with(fault_table.table()), encoding='utf-8')
