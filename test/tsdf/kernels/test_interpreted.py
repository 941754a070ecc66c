# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A distance field made without the compiler, in a process of its own, equals one made with it."""

from test.kernels.modes import saved_alike

SHORT_FUSING = """
import sys
import numpy as np
from surfel_mapper.config import TsdfConfig
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.integrator import Integrator
from surfel_mapper.tsdf.point_integrator import PointIntegrator
from surfel_mapper.tsdf.queries import sample, states
from surfel_mapper.tsdf.range_image import from_depth
from surfel_mapper.tsdf.sensors import CameraModel

rng = np.random.default_rng(1)
camera = CameraModel(columns=24, rows=18, fx=20.0, fy=20.0, cx=12.0, cy=9.0, max_range_m=4.0)
found = []
for carve_m in (20.0, 0.0):
    config = TsdfConfig(
        voxel_size_m=0.3, truncation_m=0.7, voxels_per_side=4, color=True,
        semantics='single', dynamic_labels=[1.0], threads=1, max_radius_m=4.0, carve_m=carve_m,
    )
    one = Integrator(BlockMap(config))
    depth = 2.0 + 0.1 * rng.standard_normal((18, 24))
    depth[::5, ::7] = np.nan
    depth[1::6, ::5] = np.inf
    image = from_depth(camera, depth.astype(np.float32)).with_images(
        color=rng.integers(0, 256, (18, 24, 3)).astype(np.uint8),
        label=rng.integers(-1, 4, (18, 24)),
        mask=rng.random((18, 24)) < 0.1,
    )
    points = rng.normal(size=(200, 3)) * [2.0, 2.0, 0.5]
    points[::50] = np.nan
    by_points = PointIntegrator(one.blocks)
    for number in range(3):
        pose = pose_matrix([0.2 * number, -4.0, 1.0], [0.5, -0.5, 0.5, 0.5])
        if number == 1:
            print(by_points.integrate(points, pose, number))
        else:
            print(one.integrate(image, pose, number))
        one.blocks.evict(pose[:3, 3])
        print(one.blocks.num_blocks)
    blocks = one.blocks
    places = rng.normal(size=(50, 3)) + [0.0, -2.0, 1.0]
    sampled = sample(blocks, places)
    content = blocks.copied(blocks.rows())
    found += [content.index, content.field, content.color, content.votes]
    found += [sampled.distance, sampled.gradient, states(blocks, places)]
np.savez(sys.argv[1], *found)
"""


def test_a_field_is_the_same_without_the_compiler(tmp_path):
    # The compiler may round once where numpy rounds twice.
    assert len(saved_alike(SHORT_FUSING, tmp_path, rtol=1e-5, atol=1e-5)) == 14
