# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The table of faults in docs/faults.md and what is counted there, made from the tests.

``python -m test.ros.fault_table`` writes both.

Each test of a fault states, where it stands, what happens, what is counted and what is lost; it
then holds the node to it.
"""

from __future__ import annotations

from collections.abc import Callable
import importlib
from pathlib import Path
import re
from typing import NamedTuple

from test.fuzz.harnesses import HARNESSES

PAGE = Path(__file__).parents[2] / 'docs' / 'faults.md'
MODULES = (
    'test.ros.test_among_others',
    'test.ros.test_faults_files',
    'test.ros.test_faults_input',
)
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


def figures() -> dict[str, int]:
    """Return what is counted, by the beginnings of the rows that state it."""
    tried = sum(len(harness.corpus()) + harness.number for harness in HARNESSES.values())
    return {
        '| inputs of the tests, the same in every run |': tried,
        '| faults, each a row below and a test |': len(FAULTS),
    }


def page_with(rows: str) -> str:
    """Return the page with other rows, and with the figures of today."""
    text = PAGE.read_text(encoding='utf-8')
    before, _, rest = text.partition(BEGIN)
    text = before + rows + rest.partition(END)[2]
    for row, number in figures().items():
        text = re.sub(rf'(?<=^{re.escape(row)} )[\d,]+', f'{number:,}', text, flags=re.MULTILINE)
    return text


if __name__ == '__main__':
    from test.ros import fault_table  # where the tests have entered theirs

    PAGE.write_text(fault_table.page_with(fault_table.table()), encoding='utf-8')
