# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Docstrings, comments, messages, test names and pages are plain English.

Counts constructions that hide the noun of a sentence. Each has a limit per 10,000 words, near
the rates in the docstrings of well-kept Python libraries; a failure lists every hit. Words that
could name anything are counted among the identifiers of the package in the same way.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from functools import cache
import io
from pathlib import Path
import re
import tokenize
from typing import NamedTuple

ROOT = Path(__file__).parents[1]

LIMITS = {
    r'\bwhat (is|was|are|were|it|they|there|each|has|have|had|came|comes|follows|belongs|becomes'
    r'|does|did|stands?|the|a|an|no|can|may)\b(?![^.]*\?)': 2.0,
    r'\bwhere (it|there|they|that|these|those|he|one|none|nothing|somebody)\b': 5.0,
    r'\bso (many|much|few)\b': 0.5,
    r'\b(whoever|whatever|whom|nobody|somebody|anybody|theirs)\b': 2.0,
    r'\b(that|those) which\b': 0.5,
    r'\bhangs? together\b': 0.0,
    r'\b[Rr]eturns? how (many|much|far|long|fast|large|well|often)\b': 1.5,
    r'\banew\b(?!\.)': 0.5,
    r'\bas (it|they) stands?\b': 0.5,
}
"""Regular expression of a construction: hits allowed per 10,000 words."""

OPENINGS = re.compile(r'(Be|Have|Know|Hear|What|Where|Who|Whoever|That|Those|Of)\b')
"""First words of docstrings that carry no verb of the field."""

FIRST_WORDS = re.compile(r'test_(what|where|who|whoever|of|it|they|that|those|so)_')
"""First words of the name of a test that is no fact."""

GENERAL_NAMES = re.compile(
    r'_*(found|places?|parts?|each|before|after|known|left|rest|held|given|taken|seen|those|others?'
    r'|one|things?|what|which|here|there|now|then|again|earlier|towards|middle)_*'
)
"""Names that say nothing of the value."""

MOST_GENERAL = 3.0
"""General names allowed in 1,000 lines of code; 1 to 10 in rosbags, KISS-ICP, httpx and attrs."""

NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}

STRINGS_AND_COMMENTS = re.compile(
    r"'''.*?'''" + r'|\"{3}.*?\"{3}' + r"|'(?:\\.|[^'\\])*'" + r'|"(?:\\.|[^"\\])*"'
    r'|(?P<comment>#[^\n]*)',
    re.DOTALL,
)
"""Matches whole strings first: a number sign in a string begins no comment."""


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


class Source(NamedTuple):
    """Comments, docstrings, all strings and function names of a Python file, with their lines."""

    comments: list[tuple[int, str]]
    docstrings: list[tuple[int, str]]
    """The texts under constants and fields are among them."""

    strings: list[tuple[int, str]]
    functions: list[tuple[int, str]]


@cache
def parsed(path: Path) -> Source:
    """Parse a Python file, once for all tests."""
    text = path.read_text(encoding='utf-8')
    comments = [
        (text.count('\n', 0, match.start()) + 1, match['comment'])
        for match in STRINGS_AND_COMMENTS.finditer(text)
        if match['comment']
    ]
    docstrings, strings, functions = [], [], []
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.Expr(value=ast.Constant(value=str(string))):
                docstrings.append((node.lineno, string))
            case ast.Constant(value=str(string)):
                strings.append((node.lineno, string))
            case ast.FunctionDef(name=name):
                functions.append((node.lineno, name))
    return Source(comments, docstrings, strings, functions)


@cache
def texts(path: Path) -> list[tuple[int, str]]:
    """Return line and text of everything that a reader reads as English in a file."""
    if path.suffix != '.py':
        return list(enumerate(path.read_text(encoding='utf-8').splitlines(), 1))
    source = parsed(path)
    return source.comments + [(line, string) for line, string in source.strings if ' ' in string]


def hits(pattern: str, paths: list[Path]) -> list[str]:
    """Return place and line of every match of a pattern."""
    search = re.compile(pattern).search
    found = []
    for path in paths:
        for number, text in texts(path):
            if not search(text):  # as no pattern spans lines, no line matches either
                continue
            for offset, line in enumerate(text.splitlines()):
                if search(line):
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
        for line, text in parsed(path).docstrings
        if OPENINGS.match(text.strip())
    ]
    assert not found, '\n'.join(found)


def test_names_of_tests_state_a_fact():
    found = [
        f'{path.relative_to(ROOT)}:{line}: {name}'
        for path in (ROOT / 'test').rglob('*.py')
        for line, name in parsed(path).functions
        if FIRST_WORDS.match(name)
    ]
    assert not found, '\n'.join(found)


def identifiers(tree: ast.Module) -> Iterator[str]:
    """Yield every use of a name, attribute, argument, keyword, function or class of a module."""
    for node in ast.walk(tree):
        match node:
            case (
                ast.Name(id=name)
                | ast.Attribute(attr=name)
                | ast.arg(arg=name)
                | ast.keyword(arg=str(name))
                | ast.FunctionDef(name=name)
                | ast.ClassDef(name=name)
            ):
                yield name


def num_code_lines(text: str, tree: ast.Module) -> int:
    """Return the number of lines of code; docstrings and comments do not count."""
    lines = set[int]()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                lines.difference_update(range(node.lineno, node.end_lineno + 1))
    return len(lines)


def test_names_say_what_they_hold():
    num_lines, by_file = 0, {}
    for path in (ROOT / 'surfel_mapper').rglob('*.py'):
        text = path.read_text(encoding='utf-8')
        tree = ast.parse(text)
        lines = num_code_lines(text, tree)
        names = [name for name in identifiers(tree) if GENERAL_NAMES.fullmatch(name)]
        by_file[path.relative_to(ROOT)] = (len(names), lines, Counter(names))
        num_lines += lines

    total = sum(number for number, _, _ in by_file.values())

    worst = sorted(by_file.items(), key=lambda item: item[1][0], reverse=True)[:20]
    report = [
        f'{path}: {number} in {lines} lines: '
        + ', '.join(f'{name} {uses}' for name, uses in names.most_common())
        for path, (number, lines, names) in worst
        if number
    ]
    assert total <= MOST_GENERAL * num_lines / 1e3, '\n'.join(
        [f'{total} in {num_lines} lines, {MOST_GENERAL} in 1,000 allowed; worst files:', *report]
    )
