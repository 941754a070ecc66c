# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Docstrings, comments, messages, test names and pages are plain English.

Counts constructions that hide the noun of a sentence. Each has a limit per 10,000 words, near
the rates in the docstrings of well-kept Python libraries; a failure lists every hit.
"""

from __future__ import annotations

import ast
from functools import cache
import io
from pathlib import Path
import re
import tokenize

ROOT = Path(__file__).parents[1]

LIMITS = {
    r'\bwhat (is|was|are|were|it|they|there|each|has|have|had|came|comes|follows|belongs|becomes'
    r'|does|did|stands?|the|a|an|no|can|may)\b(?![^.]*\?)': 2.0,
    r'\bwhere (it|there|they|that|these|those|he|one|none|nothing|somebody)\b': 5.0,
    r'\bso (many|much|few)\b': 0.5,
    r'\b(whoever|whatever|whom|nobody|somebody|anybody|theirs)\b': 2.0,
    r'\b(that|those) which\b': 0.5,
    r'\bhangs? together\b': 0.0,
}
"""Regular expression of a construction: hits allowed per 10,000 words."""

OPENINGS = re.compile(r'(Be|Have|Know|Hear|What|Where|Who|Whoever|That|Those|Of)\b')
"""First words of docstrings that carry no verb of the field."""

FIRST_WORDS = re.compile(r'test_(what|where|who|whoever|of|it|they|that|those|so)_')
"""First words of the name of a test that is no fact."""


def sources() -> list[Path]:
    """Return the Python files of the project."""
    return [
        path
        for top in ('surfel_mapper', 'test', 'examples')
        for path in (ROOT / top).rglob('*.py')
    ]


def pages() -> list[Path]:
    """Return the pages of the project."""
    return [*ROOT.glob('*.md'), *ROOT.glob('*.rst'), *(ROOT / 'docs').rglob('*.md')]


def docstrings(tree: ast.Module) -> list[tuple[int, str]]:
    """Return line and text of every docstring, those under constants and fields included."""
    return [
        (node.lineno, node.value.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    ]


@cache
def texts(path: Path) -> list[tuple[int, str]]:
    """Return line and text of everything that a reader reads as English in a file."""
    text = path.read_text(encoding='utf-8')
    if path.suffix != '.py':
        return [(number, line) for number, line in enumerate(text.splitlines(), 1)]
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    comments = [
        (token.start[0], token.string) for token in tokens if token.type == tokenize.COMMENT
    ]
    tree = ast.parse(text)
    strings = [
        (node.lineno, node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and ' ' in node.value
    ]
    return comments + strings


def hits(pattern: str, paths: list[Path]) -> list[str]:
    """Return place and line of every match of a pattern."""
    found = []
    for path in paths:
        for number, text in texts(path):
            for offset, line in enumerate(text.splitlines()):
                if re.search(pattern, line):
                    found.append(f'{path.relative_to(ROOT)}:{number + offset}: {line.strip()}')
    return found


def num_words(paths: list[Path]) -> int:
    """Return the number of words of some files."""
    return sum(len(text.split()) for path in paths for _, text in texts(path))


def test_constructions_that_hide_the_noun_are_rare():
    found = []
    for paths in (sources(), pages()):
        words = num_words(paths)
        for pattern, limit in LIMITS.items():
            lines = hits(pattern, paths)
            if len(lines) > limit * words / 1e4:
                found += [f'{len(lines)} in {words} words, {limit} in 10,000 allowed: {pattern}']
                found += lines
    assert not found, '\n'.join(found)


def test_docstrings_open_with_a_verb_or_a_noun():
    found = [
        f'{path.relative_to(ROOT)}:{line}: {text.strip().splitlines()[0]}'
        for path in sources()
        for line, text in docstrings(ast.parse(path.read_text(encoding='utf-8')))
        if OPENINGS.match(text.strip())
    ]
    assert not found, '\n'.join(found)


def test_names_of_tests_state_a_fact():
    found = [
        f'{path.relative_to(ROOT)}:{node.lineno}: {node.name}'
        for path in (ROOT / 'test').rglob('*.py')
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
        if isinstance(node, ast.FunctionDef) and FIRST_WORDS.match(node.name)
    ]
    assert not found, '\n'.join(found)
