# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Bash completes verbs, options, choices and settings, as docs/commands.md registers it."""

from __future__ import annotations

import os
import subprocess
import sys

import argcomplete
import pytest

ASK = """
COMP_LINE="$1" COMP_POINT=${#1} COMP_TYPE=9 COMP_WORDBREAKS=$' \\t\\n"\\'><=;|&(:'
_python_argcomplete surfel-mapper
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope='module')
def completions(tmp_path_factory):
    """Return a function that asks bash to complete a line."""
    folder = tmp_path_factory.mktemp('tools')
    command = folder / 'surfel-mapper'
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m surfel_mapper.cli.main "$@"\n')
    command.chmod(0o755)
    (folder / 'drive.mcap').touch()
    code = argcomplete.shellcode(['surfel-mapper'], shell='bash') + ASK

    def ask(line):
        done = subprocess.run(
            ['bash', '-c', code, 'bash', line],
            env={**os.environ, 'PATH': f'{folder}:{os.environ["PATH"]}'},
            cwd=folder,
            capture_output=True,
            text=True,
            check=True,
        )
        return {word.strip() for word in done.stdout.splitlines()}

    return ask


@pytest.mark.parametrize(
    ('line', 'words'),
    [
        ('surfel-mapper rep', {'replay'}),
        ('surfel-mapper filter', {'filter', 'filters'}),
        ('surfel-mapper replay drive.mcap --over', {'--overwrite'}),
        ('surfel-mapper replay d', {'drive.mcap'}),
        ('surfel-mapper extract a.ply --vo', {'--voxel-size'}),
        ('surfel-mapper replay --poses-from id', {'identity'}),
        ('surfel-mapper replay --set map.vox', {'map.voxel_size_m='}),
        ('surfel-mapper view a.npz --set window.max_s', {'window.max_scans='}),
        ('surfel-mapper simulate ', {'street'}),
    ],
)
def test_a_line_is_completed(completions, line, words):
    assert completions(line) == words
