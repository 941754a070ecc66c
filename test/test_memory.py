# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Memory kept: large blocks are used again, and lasting objects are not visited by collections."""

import os
import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
from surfel_mapper.memory import keep_freed_memory
if sys.argv[1] == 'kept':
    keep_freed_memory()
def make():
    return [b'1' * (9 << 20), b'2' * (5 << 20), b'3' * (15 << 20)]  # 7424 pages of 4 KiB
make()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    make()
print((resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) // 5)
"""


def faults_of(program, how):
    """Return the page faults that a program prints."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith('MALLOC_')}
    command = [sys.executable, '-c', program, how]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != 'glibc', reason='concerns glibc only')
def test_blocks_are_used_again_once_memory_is_kept():
    kept, given_back = (faults_of(FAULTS, how) for how in ('kept', 'given back'))
    assert kept < 100
    assert kept < 0.1 * given_back
