# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Every module of kernels has a test that compares it with a twin or an analytic reference.

The table is the place to look for that test. A test calls the kernels themselves or the module
that owns them; both are read from the imports.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / 'surfel_mapper'

REFERENCES = {
    'alignment/kernels/edges.py': 'alignment/kernels/test_edges.py',
    'alignment/kernels/registration.py': 'alignment/kernels/test_registration.py',
    'filters/kernels/boxes.py': 'filters/kernels/test_kernels.py',
    'filters/kernels/limits.py': 'filters/kernels/test_kernels.py',
    'filters/kernels/sampling.py': 'filters/test_sampling.py',
    'filters/kernels/shapes.py': 'filters/kernels/test_kernels.py',
    'filters/kernels/tensor_voting.py': 'filters/test_tensor_voting.py',
    'kernels/grouping.py': 'kernels/test_grouping.py',
    'kernels/hashing.py': 'kernels/test_hashing.py',
    'kernels/layout.py': 'mapping/kernels/test_voxels.py',
    'kernels/polygons.py': 'pipeline/test_regions.py',
    'kernels/prefetch.py': 'kernels/test_prefetch.py',
    'kernels/projection.py': 'kernels/test_projection.py',
    'kernels/quantisation.py': 'mapping/kernels/test_reduction.py',
    'kernels/selection.py': 'kernels/test_selection.py',
    'kernels/symmetric3.py': 'kernels/test_symmetric3.py',
    'kernels/voxel_grid.py': 'filters/test_grids.py',
    'layers/dynamic_objects/kernels/free_space.py': 'layers/test_free_space.py',
    'mapping/kernels/queries.py': 'mapping/kernels/test_queries.py',
    'mapping/kernels/reduction.py': 'mapping/kernels/test_reduction.py',
    'mapping/kernels/surfels.py': 'mapping/kernels/test_surfels.py',
    'mapping/kernels/voxels.py': 'mapping/kernels/test_voxels.py',
    'messages/kernels/attach.py': 'messages/test_scan_normals.py',
    'messages/kernels/discs.py': 'messages/test_surfel_markers.py',
    'models/kernels/bisection.py': 'models/kernels/test_bisection.py',
    'models/kernels/bspline.py': 'models/test_bspline.py',
    'models/kernels/bspline_incremental.py': 'models/kernels/test_bspline_incremental.py',
    'models/kernels/charts.py': 'models/kernels/test_charts.py',
    'models/kernels/frames.py': 'models/test_segmentation.py',
    'models/kernels/gaussian_mixture.py': 'models/kernels/test_bisection.py',
    'models/kernels/grid.py': 'models/test_grid.py',
    'models/kernels/growth.py': 'models/kernels/test_growth.py',
    'models/kernels/outlines.py': 'models/test_outlines.py',
    'models/kernels/patches.py': 'models/kernels/test_patches.py',
    'models/kernels/region_merging.py': 'models/kernels/test_patches.py',
    'models/kernels/surfel_classes.py': 'models/kernels/test_surfels.py',
    'models/kernels/surfel_groups.py': 'models/kernels/test_surfels.py',
    'models/kernels/surfel_links.py': 'models/kernels/test_surfels.py',
    'models/kernels/voxel_means.py': 'models/kernels/test_voxel_means.py',
    'models/kernels/voxel_points.py': 'models/kernels/test_growth.py',
    'sensors/kernels/depth.py': 'sensors/test_depth.py',
    'sensors/kernels/deskew.py': 'sensors/test_deskew.py',
    'simulation/kernels/raycast.py': 'simulation/kernels/test_raycast.py',
    'simulation/kernels/surfaces.py': 'simulation/kernels/test_raycast.py',
    'tsdf/kernels/block_marks.py': 'tsdf/test_selection.py',
    'tsdf/kernels/blocks.py': 'tsdf/test_blocks.py',
    'tsdf/kernels/channels.py': 'tsdf/test_labels.py',
    'tsdf/kernels/integration.py': 'tsdf/test_twin.py',
    'tsdf/kernels/lookup.py': 'tsdf/test_range_image.py',
    'tsdf/kernels/marching_cubes.py': 'tsdf/test_mesh.py',
    'tsdf/kernels/point_fusion.py': 'tsdf/test_point_integrator.py',
    'tsdf/kernels/queries.py': 'tsdf/test_queries.py',
    'tsdf/kernels/range_image.py': 'tsdf/test_range_image.py',
    'viz/kernels/painting.py': 'viz/kernels/test_painting.py',
}
"""Module of kernels, under surfel_mapper/: the test with its twin or reference, under test/."""


def imported(path: Path) -> set[Path]:
    """Return the modules of package and tests that a module imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f'{node.module}.{alias.name}' for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    paths = {ROOT / f'{name.replace(".", "/")}.py' for name in names}
    return {found for found in paths if found.is_file()}


def reaches(test: Path, kernels: Path) -> bool:
    """Whether a test, or a twin beside it, imports kernels or a module that imports them."""
    near = imported(test)
    near |= {each for twin in near if ROOT / 'test' in twin.parents for each in imported(twin)}
    return kernels in near or any(kernels in imported(module) for module in near)


def test_every_module_of_kernels_has_its_reference():
    modules = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.glob('**/kernels/*.py')
        if path.name != '__init__.py'
    }
    wrong = [f'{name}: in no line of the table' for name in sorted(modules - REFERENCES.keys())]
    wrong += [f'{name}: no such module' for name in sorted(REFERENCES.keys() - modules)]
    for name in sorted(modules & REFERENCES.keys()):
        test = ROOT / 'test' / REFERENCES[name]
        if not test.is_file():
            wrong.append(f'{name}: no test/{REFERENCES[name]}')
        elif not reaches(test, PACKAGE / name):
            wrong.append(f'{name}: test/{REFERENCES[name]} imports neither it nor its owner')
    assert not wrong, '\n'.join(wrong)
