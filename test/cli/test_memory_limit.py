# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A verb that reads files runs under a limit of address space, and refuses what exceeds it."""

import resource
import subprocess
import sys

import pytest

from surfel_mapper.cli.main import main

PROGRAM = """
import resource, sys
import numpy as np
from surfel_mapper.cli import info, main, view
def run(args):
    print(resource.getrlimit(resource.RLIMIT_AS)[0])
    np.ones(1 << 60, np.uint8)
info.run = view.run = run
sys.exit(main.main())
"""


def run(verb, path):
    """Run a verb that allocates 2**60 bytes, with 1 MB as the limit."""
    return subprocess.run(
        [sys.executable, '-c', PROGRAM, verb, str(path)],
        capture_output=True,
        text=True,
        check=False,
        env={'SURFEL_MAPPER_MAX_BYTES': '1000000', 'PYTHONPATH': ':'.join(sys.path)},
    )


def test_an_allocation_beyond_the_memory_is_a_refusal_that_names_the_file(tmp_path):
    done = run('info', tmp_path / 'a.mcap')
    assert done.returncode == 1
    assert done.stderr.startswith(
        f'surfel-mapper info: {tmp_path}/a.mcap: needs more memory than there is (Unable to allo'
    )
    assert len(done.stderr.splitlines()) == 1
    assert 1_000_000 < int(done.stdout) < 1 << 40


def test_a_verb_that_starts_a_browser_has_no_limit(tmp_path):
    done = run('view', tmp_path / 'a.mcap')
    assert int(done.stdout) == resource.getrlimit(resource.RLIMIT_AS)[0]


def test_a_call_from_python_leaves_the_limit_as_it_is(tmp_path):
    limit = resource.getrlimit(resource.RLIMIT_AS)
    assert main(['info', str(tmp_path / 'none.mcap')]) == 1
    assert resource.getrlimit(resource.RLIMIT_AS) == limit


@pytest.mark.parametrize('suffix', ['ply', 'pcd'])
def test_a_text_that_claims_more_points_than_memory_is_refused_by_its_name(tmp_path, suffix):
    head = {
        'ply': 'ply\nformat ascii 1.0\nelement vertex {0}\nproperty float x\nproperty float y\n'
        'property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n',
        'pcd': 'VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\n'
        'HEIGHT 1\nPOINTS {0}\nDATA ascii\n',
    }[suffix]
    folder = tmp_path / 'scans'
    folder.mkdir()
    (folder / f'a.{suffix}').write_text(head.format(10**15) + '1 2 3\n')
    command = [sys.executable, '-m', 'surfel_mapper.cli.main', 'replay', str(folder)]
    done = subprocess.run(
        [*command, '--poses-from', 'identity', '--output', str(tmp_path / 'out')],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert f'a.{suffix}: ' in done.stderr
    assert 'Traceback' not in done.stderr
