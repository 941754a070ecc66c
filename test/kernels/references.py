# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The test of each module of kernels that compares it with a twin or an analytic reference.

`python -m test.kernels.references` lists the tests, for `make boundscheck`; test_references.py
compares the table with the modules that there are.
"""

REFERENCES = {
    'alignment/kernels/edges.py': 'alignment/kernels/test_edges.py',
    'alignment/kernels/planes.py': 'alignment/kernels/test_planes.py',
    'alignment/kernels/registration.py': 'alignment/kernels/test_registration.py',
    'alignment/kernels/steps.py': 'alignment/test_registration.py',
    'filters/kernels/boxes.py': 'filters/test_boxes.py',
    'filters/kernels/limits.py': 'filters/test_limits.py',
    'filters/kernels/nearest.py': 'filters/test_neighbours.py',
    'filters/kernels/sampling.py': 'filters/test_sampling.py',
    'filters/kernels/search_tree.py': 'filters/test_neighbours.py',
    'filters/kernels/shapes.py': 'filters/test_neighbours.py',
    'filters/kernels/smallest.py': 'filters/test_neighbours.py',
    'filters/kernels/tensor_voting.py': 'filters/test_tensor_voting.py',
    'filters/kernels/voxel_grid.py': 'filters/test_grids.py',
    'kernels/compiling.py': 'kernels/test_compiling.py',
    'kernels/grouping.py': 'kernels/test_grouping.py',
    'kernels/hashing.py': 'kernels/test_hashing.py',
    'kernels/lanes.py': 'kernels/test_lanes.py',
    'kernels/layout.py': 'mapping/kernels/test_rows.py',
    'kernels/prefetch.py': 'mapping/test_moments.py',
    'kernels/quantisation.py': 'mapping/test_moments.py',
    'kernels/symmetric3.py': 'kernels/test_symmetric3.py',
    'mapping/kernels/adaptive.py': 'mapping/test_adaptive.py',
    'mapping/kernels/queries.py': 'mapping/test_ages.py',
    'mapping/kernels/reduction.py': 'mapping/test_moments.py',
    'mapping/kernels/rows.py': 'mapping/kernels/test_rows.py',
    'mapping/kernels/surfels.py': 'mapping/kernels/test_surfels.py',
    'mapping/kernels/voxels.py': 'mapping/test_surfel_map.py',
    'models/kernels/bisection.py': 'models/kernels/test_bisection.py',
    'models/kernels/coverage.py': 'models/test_coverage.py',
    'models/kernels/frames.py': 'models/kernels/test_frames.py',
    'models/kernels/gaussian_mixture.py': 'models/kernels/test_bisection.py',
    'models/kernels/joining.py': 'models/kernels/test_joining.py',
    'models/kernels/growth.py': 'models/kernels/test_growth.py',
    'models/kernels/noise.py': 'models/test_noise.py',
    'models/kernels/outlines.py': 'models/test_outlines.py',
    'models/kernels/region_merging.py': 'models/kernels/test_patches.py',
    'models/kernels/splines.py': 'models/test_bspline.py',
    'models/kernels/surfel_classes.py': 'models/kernels/test_surfels.py',
    'models/kernels/surfel_links.py': 'models/test_live.py',
    'models/kernels/voxel_means.py': 'models/test_thinning.py',
    'models/kernels/voxel_points.py': 'models/kernels/test_growth.py',
    'sensors/kernels/depth.py': 'sensors/test_depth.py',
    'sensors/kernels/deskew.py': 'sensors/test_deskew.py',
    'simulation/kernels/raycast.py': 'simulation/kernels/test_raycast.py',
    'simulation/kernels/surfaces.py': 'simulation/kernels/test_raycast.py',
    'tsdf/kernels/block_marks.py': 'tsdf/test_selection.py',
    'tsdf/kernels/blocks.py': 'tsdf/test_blocks.py',
    'tsdf/kernels/channels.py': 'tsdf/test_queries.py',
    'tsdf/kernels/euclidean.py': 'tsdf/test_euclidean.py',
    'tsdf/kernels/integration.py': 'tsdf/test_twin.py',
    'tsdf/kernels/lookup.py': 'tsdf/test_twin.py',
    'tsdf/kernels/projection.py': 'tsdf/kernels/test_projection.py',
    'tsdf/kernels/marching_cubes.py': 'tsdf/test_mesh.py',
    'tsdf/kernels/point_cells.py': 'tsdf/test_point_integrator.py',
    'tsdf/kernels/point_fusion.py': 'tsdf/test_point_integrator.py',
    'tsdf/kernels/queries.py': 'tsdf/test_queries.py',
    'viz/kernels/painting.py': 'viz/kernels/test_painting.py',
}
"""Module of kernels, under surfel_mapper/: the test with its twin or reference, under test/."""


if __name__ == '__main__':
    print(*sorted({f'test/{name}' for name in REFERENCES.values()}))
