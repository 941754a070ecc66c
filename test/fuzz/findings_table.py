# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The table of inputs in SECURITY.md, generated from the tests of test_findings.py.

``python -m test.fuzz.claims`` writes it. Each of these tests states input, past cost and its own
bounds in a decorator, and then checks them. Stands alone because the tests import it.
"""

from __future__ import annotations

from collections.abc import Callable
import importlib
from typing import NamedTuple

BEGIN, END = '<!-- begin: generated from test/fuzz/test_findings.py -->', '<!-- end: findings -->'


class Finding(NamedTuple):
    """An input, its cost before the mend, and the bounds of its test."""

    name: str
    before: str
    now: str


FINDINGS: list[Finding] = []


def finding(name: str, *, before: str, now: str) -> Callable:
    """Register a test as that of a finding."""
    FINDINGS.append(Finding(name, before, now))
    return lambda test: test


def table() -> str:
    """Return the table of all findings, in the order of their tests."""
    importlib.import_module('test.fuzz.test_findings')
    rows = ['| input | before | now |', '|---|---|---|']
    rows += [f'| {" | ".join(entry)} |' for entry in FINDINGS]
    return '\n'.join([BEGIN, *rows, END])
