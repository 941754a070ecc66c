# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The filters, parameters, defaults and bounds that libpointmatcher registers, restated as data.

Each parameter is (default, low, high), None for low and high if it checks no bounds; types
are those of the defaults. Flags are True and False.
"""

from math import inf

INT = 2**31 - 1
UNSIGNED = 2**32 - 1

FLAG_OFF = (False, None, None)
FLAG_ON = (True, None, None)
ANY = (-inf, inf)

BOX_KEEPS = {
    'keepNormals': FLAG_ON,
    'keepDensities': FLAG_OFF,
    'keepEigenValues': FLAG_OFF,
    'keepEigenVectors': FLAG_OFF,
}

FILTERS = {
    'AddDescriptor': {
        'descriptorName': ('testDescriptor', None, None),
        'descriptorDimension': (1, 1, UNSIGNED),
        'descriptorValues': ((), None, None),
    },
    'AngleLimit': {
        'phiMin': (-inf, *ANY),
        'phiMax': (-inf, *ANY),
        'thetaMin': (-inf, *ANY),
        'thetaMax': (-inf, *ANY),
        'removeInside': FLAG_ON,
    },
    'Identity': {},
    'RemoveNaN': {},
    'MaxDist': {'dim': (-1, -1, 2), 'maxDist': (1.0, *ANY)},
    'MinDist': {'dim': (-1, -1, 2), 'minDist': (1.0, *ANY)},
    'BoundingBox': {
        'xMin': (-1.0, *ANY),
        'xMax': (1.0, *ANY),
        'yMin': (-1.0, *ANY),
        'yMax': (1.0, *ANY),
        'zMin': (-1.0, *ANY),
        'zMax': (1.0, *ANY),
        'removeInside': FLAG_ON,
    },
    'MaxQuantileOnAxis': {
        'dim': (0, 0, 2),
        'ratio': (0.5, 1e-7, 0.9999999),
        'removeBeyond': FLAG_ON,
    },
    'MaxDensity': {'maxDensity': (10.0, 1e-7, inf)},
    'SurfaceNormal': {
        'knn': (5, 3, INT),
        'maxDist': (inf, 0.0, inf),
        'epsilon': (0.0, 0.0, inf),
        'keepNormals': FLAG_ON,
        'keepDensities': FLAG_OFF,
        'keepEigenValues': FLAG_OFF,
        'keepEigenVectors': FLAG_OFF,
        'keepMatchedIds': FLAG_OFF,
        'keepMeanDist': FLAG_OFF,
        'sortEigen': FLAG_OFF,
        'smoothNormals': FLAG_OFF,
    },
    'SamplingSurfaceNormal': {
        'ratio': (0.5, 1e-7, 1.0),
        'knn': (7, 3, INT),
        'samplingMethod': (0, 0, 1),
        'maxBoxDim': (inf, None, None),
        'averageExistingDescriptors': FLAG_ON,
        **BOX_KEEPS,
    },
    'OrientNormals': {'towardCenter': FLAG_ON},
    'IncidenceAngle': {},
    'RandomSampling': {
        'prob': (0.75, 0.0, 1.0),
        'randomSamplingMethod': (0, 0, 1),
        'seed': (-1, -1, INT),
    },
    'MaxPointCount': {'seed': (1, 0, INT), 'maxCount': (1000, 0, INT)},
    'FixStepSampling': {
        'startStep': (10, 1, INT),
        'endStep': (10, 1, INT),
        'stepMult': (1.0, 1e-7, inf),
    },
    'Shadow': {'eps': (0.1, 0.0, 3.1416)},
    'SimpleSensorNoise': {'sensorType': (0, 0, INT), 'gain': (1.0, 1.0, inf)},
    'ObservationDirection': {
        'x': (0.0, None, None),
        'y': (0.0, None, None),
        'z': (0.0, None, None),
    },
    'VoxelGrid': {
        'vSizeX': (1.0, 0.001, inf),
        'vSizeY': (1.0, 0.001, inf),
        'vSizeZ': (1.0, 0.001, inf),
        'useCentroid': FLAG_ON,
        'averageExistingDescriptors': FLAG_ON,
    },
    'CutAtDescriptorThreshold': {
        'descName': ('none', None, None),
        'useLargerThan': FLAG_ON,
        'threshold': (0.0, *ANY),
    },
    'Elipsoids': {
        'ratio': (0.5, 1e-7, 0.9999999),
        'knn': (7, 3, INT),
        'samplingMethod': (0, 0, 1),
        'maxBoxDim': (inf, None, None),
        'averageExistingDescriptors': FLAG_ON,
        'maxTimeWindow': (inf, None, None),
        'minPlanarity': (0.0, None, None),
        **BOX_KEEPS,
        'keepMeans': FLAG_OFF,
        'keepCovariances': FLAG_OFF,
        'keepWeights': FLAG_OFF,
        'keepShapes': FLAG_OFF,
        'keepIndices': FLAG_OFF,
    },
    'Gestalt': {
        'ratio': (0.1, 1e-7, 0.9999999),
        'radius': (5.0, 0.1, float(INT)),
        'knn': (7, 3, INT),
        'vSizeX': (1.0, *ANY),
        'vSizeY': (1.0, *ANY),
        'vSizeZ': (1.0, *ANY),
        'keepMeans': FLAG_OFF,
        'maxBoxDim': (inf, None, None),
        'averageExistingDescriptors': FLAG_ON,
        'maxTimeWindow': (inf, None, None),
        'keepNormals': FLAG_ON,
        'keepEigenValues': FLAG_OFF,
        'keepEigenVectors': FLAG_OFF,
        'keepCovariances': FLAG_OFF,
        'keepGestaltFeatures': FLAG_ON,
    },
    'OctreeGrid': {
        'buildParallel': FLAG_ON,
        'maxPointByNode': (1, 1, UNSIGNED),
        'maxSizeByNode': (0.0, 0.0, inf),
        'samplingMethod': (0, 0, 3),
    },
    'NormalSpace': {
        'nbSample': (5000, 1, UNSIGNED),
        'seed': (1, 0, UNSIGNED),
        'epsilon': (0.09817477042, 0.04908738521, 3.14159265359),
    },
    'CovarianceSampling': {'nbSample': (5000, 1, UNSIGNED), 'torqueNorm': (1, 0, 2)},
    'DistanceLimit': {'dim': (-1, -1, 2), 'dist': (1.0, *ANY), 'removeInside': FLAG_ON},
    'RemoveSensorBias': {'sensorType': (0, 0, 1), 'angleThreshold': (88.0, 0.0, 90.0)},
    'Sphericality': {'keepUnstructureness': FLAG_OFF, 'keepStructureness': FLAG_OFF},
    'Saliency': {
        'k': (50, 6, UNSIGNED),
        'sigma': (0.2, 0.0, inf),
        'keepNormals': FLAG_ON,
        'keepLabels': FLAG_ON,
        'keepTensors': FLAG_ON,
    },
    'SpectralDecomposition': {
        'k': (50, 6, UNSIGNED),
        'sigma': (0.2, 0.0, inf),
        'radius': (0.4, 0.0, inf),
        'itMax': (10, 1, UNSIGNED),
        'keepNormals': FLAG_ON,
        'keepLabels': FLAG_ON,
        'keepLambdas': FLAG_ON,
        'keepTensors': FLAG_ON,
    },
}

NARROWER = {
    ('SimpleSensorNoise', 'sensorType'): (0, 4),
    **dict.fromkeys([('Gestalt', f'vSize{axis}') for axis in 'XYZ'], (0.001, inf)),
}
"""Bounds here that are narrower: libpointmatcher refuses values within its own bounds."""
