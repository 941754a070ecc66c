# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Every tutorial is followed line by line, and its output is as shown.

``pycon`` blocks are doctests that share one namespace. In ``console`` blocks lines after ``$ ``
are commands of a shell, and the lines below are their output: ``...`` stands for any text
within a line, and alone on a line for any lines.
"""

from __future__ import annotations

import doctest
import os
from pathlib import Path
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest

from surfel_mapper import SurfelMap
from surfel_mapper.cli.main import main
from test import extras

ROOT = Path(__file__).parents[2]
TUTORIALS = ROOT / 'docs' / 'tutorials'
OPTIONS = doctest.ELLIPSIS


def blocks(name, language):
    text = (TUTORIALS / name).read_text(encoding='utf-8')
    return re.findall(rf'^```{language}\n(.*?)^```', text, flags=re.MULTILINE | re.DOTALL)


def pages(language):
    names = [path.name for path in sorted(TUTORIALS.glob('*.md')) if blocks(path.name, language)]
    assert names
    return names


def pattern(shown):
    """Return an expression for the output that a tutorial shows."""
    parts = [
        '(?:.*\n)*' if line == '...' else '.*'.join(map(re.escape, line.split('...'))) + '\n'
        for line in shown
    ]
    return ''.join(parts)


def steps(block):
    """Yield every command of a block with the lines shown below it."""
    for step in re.split(r'^\$ ', block, flags=re.MULTILINE)[1:]:
        command, *shown = step.rstrip('\n').split('\n')
        yield command, [line.strip() for line in shown]


def shell_path(folder):
    """Return a PATH on which surfel-mapper and python are ours, by scripts in a folder."""
    tools = folder / 'tools'
    tools.mkdir()
    for name, arguments in (('python', ''), ('surfel-mapper', ' -m surfel_mapper.cli.main')):
        (tools / name).write_text(f'#!/bin/sh\nexec "{sys.executable}"{arguments} "$@"\n')
        (tools / name).chmod(0o755)
    return f'{tools}:{os.environ["PATH"]}'


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    """
    Return a function that runs a command in a folder, with surfel-mapper and python ours.

    A verb alone runs in this process, which has its modules and kernels loaded.
    """
    path = shell_path(tmp_path)
    folder = tmp_path / 'folder'
    folder.mkdir()

    def run(command):
        verb, *arguments = shlex.split(command)
        if verb == 'surfel-mapper' and not set(command) & set('|&;<>$*'):
            with monkeypatch.context() as patch:
                patch.chdir(folder)
                code = main(arguments)
            printed = capsys.readouterr()
            assert code == 0, f'{command}\n{printed.err}'
            return stripped(printed.out)
        done = subprocess.run(
            ['bash', '-o', 'pipefail', '-c', command],
            cwd=folder,
            env={**os.environ, 'PATH': path, 'PYTHONPATH': str(ROOT)},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, f'{command}\n{done.stderr}'
        return stripped(done.stdout)

    return run


def stripped(printed):
    """Return lines without the spaces around them."""
    return ''.join(f'{line.strip()}\n' for line in printed.splitlines())


@pytest.mark.usefixtures('undrawn')
@pytest.mark.parametrize('name', pages('console'))
def test_every_command_of_a_tutorial_prints_what_is_shown(name, shell):
    if name == 'many_bags.md':
        extras.load('distributed')
    for block in blocks(name, 'console'):
        for command, shown in steps(block):
            printed = shell(command)
            assert re.fullmatch(pattern(shown), printed), f'{command}\n{printed}'


@pytest.mark.parametrize('name', pages('pycon'))
def test_every_line_of_python_in_a_tutorial_gives_what_is_shown(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parser, runner = doctest.DocTestParser(), doctest.DocTestRunner(optionflags=OPTIONS)
    names, said = {}, []
    for number, block in enumerate(blocks(name, 'pycon')):
        test = parser.get_doctest(block, names, f'{name} block {number}', None, 0)
        runner.run(test, out=said.append, clear_globs=False)
        names = test.globs
    assert runner.tries > 20
    assert runner.failures == 0, ''.join(said)


def test_the_format_that_shows_how_to_extend_is_written(tmp_path):
    text = (ROOT / 'docs' / 'extending.md').read_text(encoding='utf-8')
    code = re.findall(r'^```python\n(.*?)^```', text, flags=re.MULTILINE | re.DOTALL)
    names = {}
    exec(next(block for block in code if 'def write_csv' in block), names)
    surfel_map = SurfelMap(0.5)
    surfel_map.add([[0.1, 0.2, 0.3]])
    names['write_csv'](tmp_path / 'map.csv', surfel_map.surfels())
    written = np.loadtxt(tmp_path / 'map.csv', delimiter=',')
    assert written == pytest.approx([0.1, 0.2, 0.3], abs=1e-5)  # quantised to 8 micrometres


def test_three_dots_stand_for_text_in_a_line_and_for_lines():
    assert re.fullmatch(pattern(['a ... c', '...']), 'a b c\nd\ne\n')
    assert not re.fullmatch(pattern(['a ... c']), 'a b\nc\n')
