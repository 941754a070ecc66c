# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""T20: a saved and loaded TSDF is the same; damaged files and other settings are refused."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.state import load_state, save_state
from surfel_mapper.files.tsdf_state import load_tsdf, save_tsdf
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.integrator import Integrator
from test.tsdf.scenes import image_of, SMALL

PLAIN = TsdfConfig(voxel_size_m=0.2, truncation_m=0.6)
FULL = replace(PLAIN, color=True, semantics='single')
NAMES = ('index', 'stamp_ns', 'field', 'color', 'votes')


def image():
    rng = np.random.default_rng(1)
    return image_of(SMALL, rng.uniform(1.9, 2.1, (60, 80))).with_images(
        color=rng.integers(0, 256, (60, 80, 3)).astype(np.uint8),
        label=rng.integers(-1, 9, (60, 80)),
    )


def filled(config):
    one = Integrator(BlockMap(config))
    one.integrate(image(), np.eye(4), 123)
    return one


def content(blocks):
    """Return what blocks hold, by index."""
    rows = blocks.rows()
    rows = rows[np.lexsort(blocks.index(rows).T)]
    return [getattr(blocks.copied(rows), name).tobytes() for name in NAMES]


@pytest.mark.parametrize('config', [PLAIN, FULL], ids=['plain', 'full'])
@pytest.mark.parametrize('compress', [False, True])
def test_a_loaded_tsdf_equals_the_saved_one_and_continues(tmp_path, config, compress):
    one, path = filled(config), tmp_path / 'map.tsdf.npz'
    save_tsdf(path, one.blocks, compress=compress)
    other = Integrator(load_tsdf(path, config))
    assert content(other.blocks) == content(one.blocks)
    for each in (one, other):
        each.integrate(image(), np.eye(4), 456)
    assert content(other.blocks) == content(one.blocks)


def test_an_empty_map_is_saved(tmp_path):
    save_tsdf(tmp_path / 'a', BlockMap(FULL))
    assert load_tsdf(tmp_path / 'a', FULL).num_blocks == 0


@pytest.mark.parametrize(
    'other',
    [
        {'voxel_size_m': 0.1},
        {'voxels_per_side': 16},
        {'truncation_m': 0.5},
        {'color': False},
        {'semantics': 'none'},
    ],
    ids=str,
)
def test_a_file_of_another_shape_is_refused(tmp_path, other):
    save_tsdf(tmp_path / 'a', filled(FULL).blocks)
    with pytest.raises(FileFormatError, match=r'expected layers\.tsdf\.'):
        load_tsdf(tmp_path / 'a', TsdfConfig(**{**asdict(FULL), **other}))


def changed(name, change):
    """Return arrays with one of them changed."""

    def apply(arrays):
        arrays[name] = change(arrays[name].copy())

    return apply


def with_value(place, value):
    def apply(array):
        array[place] = value
        return array

    return apply


@pytest.mark.parametrize(
    'damage',
    [
        changed('index', with_value(1, 0)),
        changed('index', with_value((0, 0), 1 << 20)),
        changed('index', lambda a: a[:-1]),
        changed('field', with_value((0, 0, 0), 0.7)),
        changed('field', with_value((0, 1, 0), -1.0)),
        changed('field', lambda a: a[:, :, :-1]),
        changed('votes', lambda a: a[:0]),
        lambda arrays: arrays.pop('stamp_ns'),
    ],
)
def test_damaged_content_is_refused(tmp_path, damage):
    save_tsdf(tmp_path / 'a', filled(FULL).blocks)
    arrays, attributes = load_state(tmp_path / 'a')
    arrays = dict(arrays)
    if len(arrays['index']) > 1:
        arrays['index'] = arrays['index'].copy()
        arrays['index'][0] = 0
        arrays['index'][0, 0] = 900
    damage(arrays)
    save_state(tmp_path / 'b', arrays, attributes)
    with pytest.raises(FileFormatError, match='damaged'):
        load_tsdf(tmp_path / 'b', FULL)
