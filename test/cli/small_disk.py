# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A disk of a few megabytes, mounted for one process only, to be filled."""

from __future__ import annotations

from contextlib import contextmanager
import shutil
import subprocess
import sys

import pytest


def run_on_small_disk(code, folder, *arguments, size):
    """Run Python code with a disk mounted at a folder, its first argument; else skip the test."""
    if shutil.which('unshare') is None:
        pytest.skip('no unshare to mount a small disk')
    mounted = 'mount -t tmpfs -o size="$1" none "$5" && shift && exec "$@"'
    command = ['unshare', '--user', '--map-root-user', '--mount', 'sh', '-c', mounted, 'sh']
    command += [size, sys.executable, '-c', code, str(folder), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if 'mount' in done.stderr or 'unshare' in done.stderr:
        pytest.skip(f'no small disk can be mounted here: {done.stderr.strip()}')
    return done


@contextmanager
def filled(disk):
    """Fill a disk to the last byte, for as long as this holds."""
    with open(disk / 'filler', 'wb', buffering=0) as filler:
        try:
            while filler.write(bytes(4096)):
                pass
        except OSError:
            pass
    try:
        yield
    finally:
        (disk / 'filler').unlink()
