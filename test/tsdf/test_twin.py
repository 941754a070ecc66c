# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""T18: the compiled integrator against its numpy twin, and against itself with other threads."""

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.integrator import Integrator
from surfel_mapper.tsdf.range_image import from_ranges
from surfel_mapper.tsdf.selection import BlockSelection
from surfel_mapper.tsdf.sensors import LidarModel
from test.tsdf import twin
from test.tsdf.scenes import SMALL

POSE = pose_matrix([3.2, -7.1, 0.4], [0.1, -0.2, 0.3, 0.927361849549570])
COARSE = LidarModel(rows=8, columns=60, vertical_fov_deg=40.0, max_range_m=9.0)
NARROW = LidarModel(
    rows=6,
    columns=40,
    vertical_fov_deg=20.0,
    vertical_fov_top_deg=5.0,
    horizontal_fov_deg=120.0,
    max_range_m=9.0,
)
TABLE = LidarModel(
    rows=5, columns=45, beam_elevations_deg=(15.0, 6.0, 2.0, -1.0, -14.0), max_range_m=9.0
)
SENSORS = {'camera': SMALL, 'lidar': COARSE, 'narrow': NARROW, 'table': TABLE}

SETTINGS = [
    dict(),
    dict(max_difference_m=-1.0, weight_mode='constant', carve=False),  # nearest pixels only
    dict(max_difference_m=1e9),
    dict(dynamic_labels=[1.0, 3.0], max_weight=0.5),
    dict(max_ray_offset_voxels=0.0, voxels_per_side=4, min_measurement_weight=0.0),
    dict(distance='to_plane', carve=False),
]


def random_image(sensor, rng):
    """Return a bumpy image with steps, holes, pixels that clear, colours, labels and a mask."""
    shape = sensor.rows, sensor.columns
    coarse = rng.uniform(1.0, 7.0, (4, 4))
    rows = np.arange(shape[0]) * 4 // shape[0]
    columns = np.arange(shape[1]) * 4 // shape[1]
    range_m = coarse[rows][:, columns] + 0.05 * rng.standard_normal(shape)
    range_m[rng.random(shape) < 0.05] = np.nan
    range_m[rng.random(shape) < 0.05] = np.inf
    labels = rng.integers(-1, 4, (4, 4))[rows][:, columns]
    image = from_ranges(sensor, range_m.astype(np.float32))
    return image.with_images(
        color=rng.integers(0, 256, (*shape, 3)).astype(np.uint8),
        label=labels,
        mask=rng.random(shape) < 0.1,
    )


@pytest.mark.parametrize('settings', SETTINGS, ids=lambda s: ' '.join(s) or 'defaults')
@pytest.mark.parametrize('sensor', SENSORS)
def test_the_kernel_equals_its_numpy_twin(sensor, settings, monkeypatch):
    monkeypatch.setattr('surfel_mapper.tsdf.integrator.THIN_VOXELS', 0.0)  # test_thin_objects.py
    config = TsdfConfig(voxel_size_m=0.25, truncation_m=0.6, color=True, **settings)
    one, rng = Integrator(BlockMap(config)), np.random.default_rng(7)
    expected = {}
    for number in range(2):
        image = random_image(SENSORS[sensor], rng)
        if config.distance == 'to_plane':
            image = image.with_cosines(0.25)
        T = POSE.copy()
        T[0, 3] += 0.3 * number
        index = BlockSelection(config).blocks(image, T).index
        twin.integrate(config, expected, image, T, index[index @ [1, 2, 4] % 11 == 0])  # slow
        one.integrate(image, T, number)
    checked = 0
    for block, (D, W, C, W_color) in expected.items():
        row = one.blocks.find(block)
        if row < 0:
            assert not W.any()
            continue
        same = close(one.blocks.weight[row], W)
        # A voxel on the border between two pixels may fall to either side in float32.
        assert (~same).sum() <= 2, (block, one.blocks.weight[row][~same], W[~same])
        assert close(one.blocks.distance[row], D)[same].all()
        assert close(one.blocks.color[row, :3].T, C, 2e-3)[same].all()
        assert close(one.blocks.color[row, 3], W_color)[same].all()
        checked += (W > 0).sum()
    assert checked > 100


def close(found, expected, absolute=1e-5):
    return np.abs(found - expected) <= absolute + 1e-4 * np.abs(expected)


@pytest.mark.parametrize('sensor', ['camera', 'lidar'])
def test_the_result_does_not_depend_on_the_number_of_threads(sensor):
    states = []
    for threads in (1, 2, 8):
        config = TsdfConfig(voxel_size_m=0.1, color=True, semantics='single', threads=threads)
        one, rng = Integrator(BlockMap(config)), np.random.default_rng(3)
        results = [
            one.integrate(random_image(SENSORS[sensor], rng), POSE, stamp) for stamp in (5, 9)
        ]
        found = one.blocks.copied(one.blocks.rows())
        arrays = (found.index, found.stamp_ns, found.field, found.color, found.votes)
        states.append((results, [array.tobytes() for array in arrays]))
    assert states[0] == states[1] == states[2]
