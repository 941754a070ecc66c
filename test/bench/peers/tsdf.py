# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Other packages that fuse a signed distance field.

Each has a module here with a class ``Peer(job)``: ``prepared(data, pose)`` converts its input,
untimed, ``integrate`` fuses it, ``mesh`` returns vertices and triangles.
"""

from __future__ import annotations

from collections.abc import Sequence
import json
import os
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
import numpy.typing as npt

from test.bench.peers import OPEN3D, PeerSpec
from test.bench.peers.run import environment, output, ROOT

VDBFUSION = PeerSpec(
    name='VDBFusion 0.1.6',
    module='test.bench.peers.tsdf_vdbfusion',
    requires=('vdbfusion==0.1.6', 'numpy<2'),
    python='3.10',  # there are no wheels for later ones
)

OPEN3D_LEGACY = PeerSpec(
    name='Open3D 0.19 ScalableTSDFVolume',
    module='test.bench.peers.tsdf_open3d_legacy',
    requires=OPEN3D,
)

Mesh = tuple[npt.NDArray[Any], npt.NDArray[Any]]


def run_tsdf(
    peer: PeerSpec,
    cache: Path,
    scans: Sequence[Path],
    poses: npt.NDArray[np.float64],
    settings: dict[str, Any],
) -> tuple[npt.NDArray[np.float64], Mesh, float]:
    """
    Return the times of every scan, (S, 2) ms of clock and processor, the mesh, and its time, ms.

    Raises
    ------
    PeerError
        With the last line that the peer said.

    """
    python = environment(peer, cache)
    with tempfile.TemporaryDirectory() as scratch:
        files = {name: str(Path(scratch) / name) for name in ('poses.npy', 'mesh.npz')}
        np.save(files['poses.npy'], poses)
        job = {
            **settings,
            'module': peer.module,
            'scans': [str(path) for path in scans],
            'poses': files['poses.npy'],
            'mesh': files['mesh.npz'],
        }
        # Threads that wait for each other on one core only lose time.
        one_thread = {**os.environ, 'OMP_NUM_THREADS': '1'}
        command = [str(python), '-m', 'test.bench.peers.tsdf_driver']
        said = output(command, input=json.dumps(job), cwd=ROOT, env=one_thread)
        mesh = np.load(files['mesh.npz'])
        times = np.array(json.loads(said.splitlines()[-1]))
        return times, (mesh['vertices'], mesh['triangles']), float(mesh['mesh_ms'])
