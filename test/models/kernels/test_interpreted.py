# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Models made without the compiler, in a process of their own, equal those made with it."""

from test.kernels.modes import saved_alike

SHORT_MODELLING = """
import sys
import numpy as np
from surfel_mapper.config import ModelsConfig, ModelsLayerConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models import fit
from surfel_mapper.models.live import LiveModels
from surfel_mapper.models.outlines import outline
from test.models.scenes import room, VIEW

points = room(48, 36, noise_per_range_sq=1e-3)[0].astype(np.float64)
arrays = []
for profile in ('robust', 'paper'):
    model = fit(points, ModelsConfig(voxel_size_m=0.1, profile=profile), VIEW)
    arrays += [model.labels, model.gaussians.covariance, *(p.mean for p in model.patches)]
    arrays += [ring for plane in model.planes for ring in outline(plane)]
surfel_map = SurfelMap(0.3)
models = LiveModels(ModelsLayerConfig(min_points=4, noise_m=0.02), surfel_map)
moments = [surfel_map.add(part, origin=VIEW) for part in (points[::2], points[1::3])]
models.update()
surfel_map.remove(moments[0])
surfel_map.add(points[2::3], origin=VIEW)
models.update()
arrays += [models.model.labels, models.model.resample()]
np.savez(sys.argv[1], *arrays)
"""


def test_models_are_the_same_without_the_compiler(tmp_path):
    assert len(saved_alike(SHORT_MODELLING, tmp_path, rtol=1e-9, atol=1e-9)) > 20
