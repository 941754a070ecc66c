# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The table of faults in docs/faults.md and its figures, generated from the tests.

``python -m test.ros.fault_table`` writes both. Each test of a fault states the effect, the counter
and the loss in its decorator, and then checks them.
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
BEGIN, END = '<!-- begin: generated from test/ros -->', '<!-- end -->'


class Fault(NamedTuple):
    """A fault and its consequences."""

    name: str
    happens: str
    counted: str
    lost: str


FAULTS: list[Fault] = []


def fault(name: str, *, happens: str, counted: str, lost: str) -> Callable:
    """Register a test as that of a fault."""
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
    """Return the figures of the page, by the beginning of their row."""
    return {
        '| mutated inputs of the tests, the same in every run |': sum(
            harness.number for harness in HARNESSES.values()
        ),
        '| faults, each a row below and a test |': len(FAULTS),
    }


def page_with(rows: str) -> str:
    """Return the page with new rows and present figures."""
    text = PAGE.read_text(encoding='utf-8')
    before, _, rest = text.partition(BEGIN)
    text = before + rows + rest.partition(END)[2]
    for row, number in figures().items():
        text = re.sub(rf'(?<=^{re.escape(row)} )[\d,]+', f'{number:,}', text, flags=re.MULTILINE)
    return text


if __name__ == '__main__':
    from test.ros import fault_table  # the module that the tests have registered with

    PAGE.write_text(fault_table.page_with(fault_table.table()), encoding='utf-8')
