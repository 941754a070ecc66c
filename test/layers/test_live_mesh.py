# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The mesh that follows changes, against one made of the whole field at once, vertex by vertex."""

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.layers.distance_field.live_mesh import LiveMesh
from surfel_mapper.layers.layer import Moment
from surfel_mapper.tsdf.blocks import BlockMap, VISIBLE_VOXELS
from surfel_mapper.tsdf.integrator import Integrator
from surfel_mapper.tsdf.mesh import Mesher
from surfel_mapper.tsdf.queries import sample
from test.tsdf.scenes import image_of, sphere, WIDE

VOXEL_M = 0.2
SETTINGS = dict(voxel_size_m=VOXEL_M, truncation_m=0.6, carve_m=20.0)


def scans(number):
    """Yield images of a room with noise and a ball that moves, and stamps, ns."""
    rng = np.random.default_rng(3)
    for n in range(number):
        walls = 6.0 + rng.normal(0.0, 0.01, WIDE.directions.shape[:2])
        ball = sphere(WIDE, (-2.0 + 0.3 * n, 0.0, 3.0), 1.0)
        yield image_of(WIDE, np.fmin(walls, ball)), n * 10**8


def vertices_by_edge(mesher):
    """Return the place of the vertex on every edge of the lattice that has one."""
    found = {}
    for mesh in mesher._meshes.values():
        found.update(zip(map(tuple, mesh.edges.tolist()), mesh.vertices, strict=True))
    return found


@pytest.fixture
def integrator():
    return Integrator(BlockMap(TsdfConfig(**SETTINGS)))


def test_vertices_of_the_live_mesh_are_those_of_the_exact_one_within_its_tolerance(integrator):
    live = LiveMesh(integrator.blocks)
    for image, stamp_ns in scans(8):
        integrator.integrate(image, np.eye(4), stamp_ns)
        for _ in live.changed(Moment(stamp_ns=stamp_ns, frame_id='map')):
            pass
    whole = Mesher(integrator.blocks)
    whole.update()
    shown, exact = vertices_by_edge(live._mesher), vertices_by_edge(whole)
    assert shown.keys() == exact.keys()
    assert len(exact) > 2000
    # the field, linear along each edge, is 0 at the exact vertices
    places = np.array([shown[edge] for edge in exact])
    off_m = np.abs(sample(integrator.blocks, places).distance)
    known = np.isfinite(off_m)  # all eight voxels about it observed
    assert known.mean() > 0.5
    assert off_m[known].max() <= VISIBLE_VOXELS * VOXEL_M + 1e-5
    moved = [not np.array_equal(shown[edge], exact[edge]) for edge in exact]
    assert 0.0 < np.mean(moved) < 0.9
