# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Chains with the filters and values that others' public documentation shows, run as they are.

Sources: libpointmatcher, doc/ (DataFilters, ApplyingDataFilters, ICPIntro, DefaultICPConfig) and
examples/; norlab_icp_mapper, docs/ (MapperConfiguration, UsingInRos) and examples/config;
norlab_icp_mapper_ros, config/.
"""

from __future__ import annotations

import numpy as np

from surfel_mapper.filters.chain import Chain
from test.filters.examples import scan_of

MAPPER_ROS = """
input:
    - RandomSamplingDataPointsFilter:
          prob: 0.1
    - AddDescriptorDataPointsFilter:
          descriptorName: probabilityDynamic
          descriptorDimension: 1
          descriptorValues: [0.6]
    - ObservationDirectionDataPointsFilter:
    - SamplingSurfaceNormalDataPointsFilter:
          ratio: 0.5
          knn: 7
          samplingMethod: 0
          maxBoxDim: inf
          averageExistingDescriptors: 1
          keepNormals: 1
          keepDensities: 0
          keepEigenValues: 0
          keepEigenVectors: 0
icp:
    readingDataPointsFilters:
        - RandomSamplingDataPointsFilter:
              prob: 0.1
    referenceDataPointsFilters:
post:
"""

EXAMPLES = """
- BoundingBoxDataPointsFilter: {xMin: -1.0, xMax: 1.0, yMin: -1.0, yMax: 1.0, zMin: -1.0,
                                zMax: 2.0, removeInside: 1}
- MaxDistDataPointsFilter: {maxDist: 10.0, dim: -1}
- DistanceLimitDataPointsFilter: {dist: 10.0, dim: -1, removeInside: 0}
- MaxQuantileOnAxisDataPointsFilter: {dim: 0, ratio: 0.5, removeBeyond: 1}
- RandomSamplingDataPointsFilter: {prob: 0.9}
- VoxelGridDataPointsFilter: {vSizeX: 0.2, vSizeY: 0.2, vSizeZ: 0.2, useCentroid: 1}
- OctreeGridDataPointsFilter: {maxSizeByNode: 0.2, samplingMethod: 3}
- ObservationDirectionDataPointsFilter: {x: 0, y: 0, z: 0}
- SurfaceNormalDataPointsFilter: {knn: 20, epsilon: 0, keepNormals: 1, keepDensities: 1}
- OrientNormalsDataPointsFilter: {towardCenter: 1}
- NormalSpaceDataPointsFilter: {nbSample: 5000, seed: 1, epsilon: 0.09817477042}
- CovarianceSamplingDataPointsFilter: {nbSample: 25000, torqueNorm: 1}
- MaxDensityDataPointsFilter: {maxDensity: 50000}
- SimpleSensorNoiseDataPointsFilter: {sensorType: 1}
- SaliencyDataPointsFilter: {k: 50, sigma: 0.2}
- SpectralDecompositionDataPointsFilter: {k: 50, sigma: 0.2, radius: 0.2}
- SamplingSurfaceNormalDataPointsFilter: {knn: 100, ratio: 0.5, samplingMethod: 1}
- MaxPointCountDataPointsFilter: {seed: 1, maxCount: 1000}
- ShadowDataPointsFilter
"""
"""The examples of the page that lists the filters, one after another."""


def room(number=3000, seed=1):
    """Return the walls, the floor and the ceiling of a room of 12 by 8 by 3 m."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-6, -4, -1], [6, 4, 2], (number, 3))
    side = rng.integers(0, 6, number)
    limits = np.array([[-6.0, 6.0], [-4.0, 4.0], [-1.0, 2.0]])
    points[np.arange(number), side % 3] = limits[side % 3, side // 3]
    return scan_of(points.astype(np.float32), intensity=rng.uniform(0, 1, number))


def run(tmp_path, text, *keys):
    path = tmp_path / 'chain.yaml'
    path.write_text(text, encoding='utf-8')
    scan = room()
    for key in keys or ('',):
        chain = Chain.load(f'{path}#{key}')
        scan, _ = chain.run(scan)
    return scan


def test_the_filters_of_the_mapper_for_ros_run_one_after_another(tmp_path):
    keys = ('icp.readingDataPointsFilters', 'icp.referenceDataPointsFilters', 'post')
    found = run(tmp_path, MAPPER_ROS, 'input', *keys)
    assert 2 < len(found) < 60
    assert {'normals', 'observationDirections', 'probabilityDynamic'} <= set(found.columns)


def test_the_examples_of_every_filter_run_one_after_another(tmp_path):
    path = tmp_path / 'chain.yaml'
    path.write_text(EXAMPLES, encoding='utf-8')
    found, steps = Chain.load(path).run(room(20_000))
    assert len(steps) == 19
    assert 10 < len(found) <= 1000
    assert {'normals', 'densities', 'simpleSensorNoise', 'labels', 'lambda1'} <= set(found.columns)
