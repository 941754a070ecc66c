# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A peer is installed into an environment of its own and runs there, in a process."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import hashlib
import json
import os
from pathlib import Path
import re
import subprocess
import sys
import tempfile
from typing import Any

import numpy as np
import numpy.typing as npt

from test.bench.peers import PeerSpec

ROOT = Path(__file__).parents[3]

COLOUR = re.compile(r'\x1b\[[\d;]*m')

READY = 'ready'
"""A file of this name marks an environment as complete."""


class PeerError(RuntimeError):
    """A peer cannot be installed or run."""


def run_odometry(
    python: str | Path, peer: PeerSpec, scans: Sequence[Path], size_m: float
) -> tuple[dict[str, Any], npt.NDArray[np.float64]]:
    """
    Return times (milliseconds, cpu_ms), peak_mb, and pose of every scan, (S, 4, 4).

    Raises
    ------
    PeerError
        With the last line that the peer said.

    """
    with tempfile.TemporaryDirectory() as scratch:
        poses = Path(scratch) / 'poses.npy'
        job = {
            'module': peer.module,
            'scans': [str(path) for path in scans],
            'voxel_size_m': size_m,
            'poses': str(poses),
        }
        command = [str(python), '-m', 'test.bench.peers.odometry_driver']
        times = json.loads(output(command, input=json.dumps(job), cwd=ROOT))
        return times, np.load(poses)


def run_peer(
    spec: PeerSpec, points: npt.NDArray[Any], arguments: Sequence[str], cache: Path
) -> str:
    """
    Return the last line that a peer prints, given the file of the points and arguments.

    Raises
    ------
    PeerError
        If it cannot be had.

    """
    python = environment(spec, cache)
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / 'points.npy'
        np.save(path, np.ascontiguousarray(points))
        command = [str(python), '-m', spec.module, str(path), *arguments]
        return output(command, cwd=ROOT).splitlines()[-1]


def environment(peer: PeerSpec, cache: Path) -> Path:
    """
    Return the python of the environment of a peer, made if it is not there yet.

    Raises
    ------
    PeerError
        With the last line that pip said, or if there is no such Python.

    """
    version = peer.python or f'{sys.version_info.major}.{sys.version_info.minor}'
    name = hashlib.sha256(' '.join([version, *peer.requires]).encode()).hexdigest()[:12]
    directory = cache / f'venv-{name}'
    python = directory / 'bin' / 'python'
    if not (directory / READY).exists():
        print(f'installing {" ".join(peer.requires)} into {directory}', file=sys.stderr)
        output([interpreter(version), '-m', 'venv', '--clear', str(directory)])
        pip = [str(python), '-m', 'pip', 'install', '--quiet', '--disable-pip-version-check']
        output([*pip, *peer.requires])
        (directory / READY).touch()
    return python


def interpreter(version: str) -> str:
    """
    Return a Python of a version: this one, one on the path, or one of pyenv.

    Raises
    ------
    PeerError
        If there is none.

    """
    if sys.executable and version == f'{sys.version_info.major}.{sys.version_info.minor}':
        return sys.executable
    root = Path(os.environ.get('PYENV_ROOT') or Path.home() / '.pyenv')
    candidates = [*sorted(root.glob(f'versions/{version}.*/bin/python')), f'python{version}']
    for candidate in map(str, candidates):
        with contextlib.suppress(PeerError, OSError):
            output([candidate, '--version'])
            return candidate
    raise PeerError(f'needs Python {version}, which is neither on the path nor with pyenv')


def output(command: list[str], **settings: Any) -> str:
    """Return the stdout of a process, or raise PeerError."""
    done: subprocess.CompletedProcess[str] = subprocess.run(
        command, capture_output=True, text=True, check=False, **settings
    )
    if done.returncode:
        said = COLOUR.sub('', done.stderr).split('\n')
        raise PeerError([f'exit code {done.returncode}', *filter(str.strip, said)][-1])
    return done.stdout
