# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A wrong SURFEL_MAPPER_MAX_BYTES is reported as such, not as damage of the input."""

from __future__ import annotations

import subprocess
import sys

from surfel_mapper.budget import VARIABLE
from test.fuzz import corpus

MESSAGE = f"{VARIABLE}: '4G', expected a positive number of bytes, such as 4294967296"


def test_a_verb_that_reads_files_ends_with_the_message(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, '4G')
    (tmp_path / 'a.mcap').write_bytes(corpus.mcap()[0])
    command = [sys.executable, '-m', 'surfel_mapper.cli.main', 'info', str(tmp_path / 'a.mcap')]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, '')
    assert done.stderr == f'surfel-mapper info: {MESSAGE}\n'
