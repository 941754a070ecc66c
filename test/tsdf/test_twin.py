# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""T18: the compiled integrator against its numpy twin, and against itself with other threads."""

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.integrator import Integrator
from surfel_mapper.tsdf.selection import BlockSelection
from test.tsdf import twin
from test.tsdf.scenes import image_of, SMALL

POSE = pose_matrix([3.2, -7.1, 0.4], [0.1, -0.2, 0.3, 0.927361849549570])
SETTINGS = [
    (dict(), 0.2),
    (dict(carve_m=0.0), -1.0),  # nearest pixels only
    (dict(), 1e9),
    (dict(dynamic_labels=[1.0, 3.0]), 0.2),
    (dict(voxels_per_side=4), 0.2),
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
    image = image_of(sensor, range_m)
    return image.with_images(
        color=rng.integers(0, 256, (*shape, 3)).astype(np.uint8),
        label=labels,
        mask=rng.random(shape) < 0.1,
    )


@pytest.mark.parametrize(('settings', 'difference_m'), SETTINGS)
def test_the_kernel_equals_its_numpy_twin(settings, difference_m, monkeypatch):
    monkeypatch.setattr('surfel_mapper.tsdf.integrator.MAX_DIFFERENCE_M', difference_m)
    config = TsdfConfig(voxel_size_m=0.25, truncation_m=0.6, color=True, **settings)
    one, rng = Integrator(BlockMap(config)), np.random.default_rng(7)
    expected = {}
    for number in range(2):
        image = random_image(SMALL, rng)
        T = POSE.copy()
        T[0, 3] += 0.3 * number
        index = BlockSelection(config).blocks(image, T).index
        some = index[index @ [1, 2, 4] % 11 == 0]  # the twin is slow
        twin.integrate(config, expected, image, T, some, difference_m)
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


def test_the_result_does_not_depend_on_the_number_of_threads():
    states = []
    for threads in (1, 2, 8):
        config = TsdfConfig(voxel_size_m=0.1, color=True, semantics='single', threads=threads)
        one, rng = Integrator(BlockMap(config)), np.random.default_rng(3)
        results = [one.integrate(random_image(SMALL, rng), POSE, stamp) for stamp in (5, 9)]
        found = one.blocks.copied(one.blocks.rows())
        arrays = (found.index, found.stamp_ns, found.field, found.color, found.votes)
        states.append((results, [array.tobytes() for array in arrays]))
    assert states[0] == states[1] == states[2]
