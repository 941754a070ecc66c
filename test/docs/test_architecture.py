# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The page on the architecture names modules that exist, and every module that makes a thread."""

from __future__ import annotations

from pathlib import Path
import re

import pytest

import surfel_mapper
from test.settings import ROOT

PACKAGE = Path(surfel_mapper.__file__).parent
PAGE = (ROOT / 'docs' / 'architecture.md').read_text(encoding='utf-8')
MODULES = set(re.findall(r'`((?:\w+/)*\w+\.py)`', PAGE))

NOT_OF_A_MAPPER = {'cli/view.py', 'viz/recording_file.py'}
"""Threads of the command that shows a map that is in a file."""


def section(title):
    return PAGE.partition(f'## {title}\n')[2].partition('\n## ')[0]


@pytest.mark.parametrize(
    'module', sorted(MODULES - {'test/test_layering.py', 'test/reference.py'})
)
def test_modules_of_the_page_exist(module):
    assert (PACKAGE / module).is_file()


def test_a_cloud_passes_at_most_twelve_files_from_callback_to_normals():
    rows = re.findall(r'^\| \w+ \| `([^`]+)` \|', section('The path of a scan'), re.MULTILINE)
    assert 0 < len(rows) == len(set(rows)) <= 12


def test_every_module_that_makes_a_thread_is_in_the_table():
    made = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob('*.py')
        if re.search(r'\b(threading\.Thread|ThreadPoolExecutor)\(', path.read_text('utf-8'))
    }
    listed = set(re.findall(r'`((?:\w+/)*\w+\.py)`', section('Threads')))
    assert made - NOT_OF_A_MAPPER <= listed
