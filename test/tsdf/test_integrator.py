# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""T5 to T8, T12, T13, T17: one and several integrations; refused input."""

from dataclasses import replace
import math

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import ConfigError, MapLimitError, PoseError
from test.tsdf.scenes import fused, image_of, integrator, SMALL, zero_crossings

SIZES = dict(voxel_size_m=0.1, truncation_m=0.3)


def wall(sensor, range_m, **images):
    """Return an image of one range."""
    image = image_of(sensor, np.full((sensor.rows, sensor.columns), range_m))
    return image.with_images(**images)


def field(one):
    """Return blocks by index: distances and weights."""
    blocks, rows = one.blocks, one.blocks.rows()
    return dict(zip(map(tuple, blocks.index(rows)), blocks.field[rows].copy(), strict=True))


def test_a_scan_again_changes_nothing_but_the_weight_up_to_its_cap(monkeypatch):
    monkeypatch.setattr('surfel_mapper.tsdf.blocks.SETTLED', 10**9)  # free blocks too
    monkeypatch.setattr('surfel_mapper.tsdf.measurements.MAX_WEIGHT', 1.2)
    one, cap = integrator(**SIZES), 1.2
    one.integrate(wall(SMALL, 2.0), np.eye(4))
    first = field(one)
    for count in range(2, 8):
        one.integrate(wall(SMALL, 2.0), np.eye(4))
        for block, (D, W) in field(one).items():
            np.testing.assert_allclose(D, first[block][0], atol=1e-6)
            np.testing.assert_allclose(W, np.minimum(count * first[block][1], cap), rtol=1e-5)


def test_new_unobserved_blocks_are_removed_and_earlier_ones_stay():
    one = integrator(**SIZES)
    one.integrate(wall(SMALL, 2.0), np.eye(4))
    before, there = field(one), one.blocks.num_blocks
    masked = wall(SMALL, 1.0, mask=np.ones((60, 80)))
    aside = np.eye(4)
    aside[:3, 3] = [30.0, 0.0, 0.0]
    result = one.integrate(image_of(SMALL, np.full((60, 80), np.nan)), aside)
    assert (result.num_blocks, result.num_added) == (0, 0)
    result = one.integrate(masked, aside)
    assert result.num_added == one.blocks.num_blocks - there
    assert all((one.blocks.weight[row] > 0).any() for row in one.blocks.rows())
    after = field(one)
    assert all(np.array_equal(after[block], before[block]) for block in before)


@pytest.mark.parametrize(
    'T',
    [
        np.full((4, 4), np.nan),
        np.eye(3),
        np.diag([1, 1, -1, 1]),
        np.diag([2, 2, 2, 1]),
        np.diag([1.0, 1, 1, 2]),
        np.diag([1, 1, np.inf, 1]),
    ],
)
def test_invalid_pose_is_refused(T):
    one = integrator(**SIZES)
    with pytest.raises(PoseError, match='pose of the sensor'):
        one.integrate(wall(SMALL, 2.0), T)
    assert one.blocks.num_blocks == 0


def test_position_beyond_the_index_range_is_refused_and_the_map_unchanged():
    one = integrator(**SIZES)
    far = np.eye(4)
    far[0, 3] = 0.8 * (1 << 20) - 1.0
    with pytest.raises(MapLimitError, match='local frame'):
        one.integrate(wall(SMALL, 3.0), far)
    with pytest.raises(MapLimitError, match='larger voxels'):
        integrator(voxel_size_m=0.001, truncation_m=0.003).integrate(
            wall(replace(SMALL, max_range_m=10.0), 9.9), np.eye(4)
        )
    assert one.blocks.num_blocks == 0
    one.integrate(wall(SMALL, 2.0), np.eye(4))
    assert len(zero_crossings(one.blocks)) > 0


def test_a_short_truncation_is_warned_of(caplog):
    integrator(voxel_size_m=0.2, truncation_m=0.3)
    assert 'less than two voxels' in caplog.text


def caps(*pairs):
    return {'semantics': 'single', 'max_weight_by_label': pairs}


@pytest.mark.parametrize(
    ('settings', 'message'),
    [
        ({'voxels_per_side': 6}, 'voxels_per_side: 6, expected a power of two'),
        ({'truncation_m': 0.05}, 'truncation_m: 0.05, expected 0, or more than 0.1, a voxel'),
        ({'dynamic_labels': [1.5]}, 'dynamic_labels: 1.5, expected whole'),
        ({'dynamic_labels': [-1.0]}, 'dynamic_labels: -1.0, expected whole'),
        ({'label_confidence': 0.5}, 'label_confidence: 0.5, expected'),
        ({'max_weight_by_label': (7.0, 0.1)}, 'semantics: none, expected another where'),
        (caps(7.0), r'max_weight_by_label: \(7.0,\), expected pairs'),
        (caps(7.0, 0.1, 7.0, 0.2), 'max_weight_by_label: .*, expected pairs of a label, once'),
        (caps(7.0, 0.0), 'max_weight_by_label: .* and a weight from 0.0001 to 100000'),
        (caps(7.0, math.nan), 'max_weight_by_label: nan, expected a finite number'),
        (caps(7.5, 0.1), 'max_weight_by_label: 7.5, expected whole numbers from 0 to 16777215'),
        (caps(-1.0, 0.1), 'max_weight_by_label: -1.0, expected whole'),
        (
            caps(7.0, 0.1) | {'dynamic_labels': (7.0,)},
            'max_weight_by_label: .* not in dynamic_labels',
        ),
    ],
)
def test_settings_that_do_not_go_together_are_refused(settings, message):
    with pytest.raises(ConfigError, match=rf'layers\.tsdf\.{message}'):
        TsdfConfig(**settings)


@pytest.mark.parametrize('scale', [0.9998, 1.002, -1.0])
def test_a_pose_that_is_not_rigid_is_refused(scale):
    T = np.diag([scale, scale, scale, 1.0])
    with pytest.raises(PoseError, match=r'pose of the sensor: .* expected a rigid transform'):
        fused(image_of(SMALL, np.full((60, 80), 2.0)), T, voxel_size_m=0.1)


def test_an_image_is_charged_for_its_working_memory():
    one = integrator(**SIZES)
    one.blocks.max_bytes = 1000  # two bits for each of 17 blocks a side are 1228 bytes
    with pytest.raises(MapLimitError, match=r'ranges up to 4.9 m: 1228 bytes .*map\.max_bytes'):
        one.integrate(wall(SMALL, 4.9), np.eye(4))
    assert one.blocks.num_blocks == 0
