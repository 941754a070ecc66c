# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Every module of kernels has a test that compares it with a twin or an analytic reference.

The table in references.py names it. A test calls the kernels themselves or the module that owns
them; both are read from the imports.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

from test.kernels.references import REFERENCES

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / 'surfel_mapper'


@cache
def imported(path: Path) -> frozenset[Path]:
    """Return the modules of package and tests that a module imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f'{node.module}.{alias.name}' for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    paths = {ROOT / f'{name.replace(".", "/")}.py' for name in names}
    return frozenset(found for found in paths if found.is_file())


def reaches(test: Path, kernels: Path) -> bool:
    """Return whether a test imports kernels, their owner, or a module or twin with the owner."""
    modules = {test}
    for _ in range(3):
        modules |= {imported_module for module in modules for imported_module in imported(module)}
    return kernels in modules


def test_every_module_of_kernels_has_its_reference():
    modules = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.glob('**/kernels/*.py')
        if path.name != '__init__.py'
    }
    wrong = [f'{name}: in no line of the table' for name in sorted(modules - REFERENCES.keys())]
    wrong += [f'{name}: no such module' for name in sorted(REFERENCES.keys() - modules)]
    for name in sorted(modules & REFERENCES.keys()):
        test = ROOT / 'test' / REFERENCES[name]
        if not test.is_file():
            wrong.append(f'{name}: no test/{REFERENCES[name]}')
        elif not reaches(test, PACKAGE / name):
            wrong.append(f'{name}: test/{REFERENCES[name]} imports neither it nor its owner')
    assert not wrong, '\n'.join(wrong)
