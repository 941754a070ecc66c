# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Blocks that leave a field, and come back from the archive as if they had stayed."""

import gc

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files import tsdf_archive
from surfel_mapper.files.tsdf_archive import BlockArchive
from surfel_mapper.tsdf.blocks import BlockMap
from test.tsdf.scenes import image_of, integrator, SMALL


def seen(**settings):
    one = integrator(voxel_size_m=0.1, truncation_m=0.3, color=True, tracking=True, **settings)
    color = np.arange(60 * 80 * 3, dtype=np.uint8).reshape(60, 80, 3)
    image = image_of(SMALL, 2.0 * SMALL.ray_length)
    one.integrate(image.with_images(color=color, label=np.full((60, 80), 3)), np.eye(4), 5)
    return one.blocks


@pytest.mark.parametrize('chunk', [10, 10**6])
def test_blocks_come_back_as_they_left(tmp_path, monkeypatch, chunk):
    monkeypatch.setattr(tsdf_archive, 'CHUNK', chunk)
    blocks = seen(semantics='single')
    rows = blocks.rows()
    expected = blocks.copied(rows)
    archive = BlockArchive(tmp_path / 'new')
    for part in np.array_split(rows, 7):
        archive.add(blocks.remove(part))
    assert (blocks.num_blocks, archive.num_blocks) == (0, len(rows))
    assert (len(list((tmp_path / 'new').rglob('*.npz'))) > 1) == (chunk == 10)
    whole = BlockMap(blocks.config)
    for part in archive:
        whole.merge(part)
    found = whole.copied(whole.find(expected.index))
    for name in ('field', 'color', 'votes', 'stamps', 'stamp_ns'):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    archive.clear()
    assert not list(archive)
    assert not list((tmp_path / 'new').rglob('*.npz'))
    del archive
    gc.collect()
    assert not list((tmp_path / 'new').iterdir())


def test_a_block_seen_in_two_visits_is_the_weighted_mean_of_both():
    config = TsdfConfig(semantics='majority', num_labels=2, color=True, max_weight=6.0)
    one, other, index = BlockMap(config), BlockMap(config), [[1, 2, 3]]
    for blocks, distance, weight, red, votes in (
        (one, 0.1, 1.0, 0.0, (4.0, 0.0)),
        (other, 0.3, 3.0, 200.0, (1.0, 6.0)),
    ):
        (row,) = blocks.place(index)
        blocks.field[row] = [[distance], [weight]]
        blocks.field[row, 1, 7] = 0.0
        blocks.color[row, 0], blocks.color[row, 3] = red, weight
        blocks.votes[row] = np.array(votes)[:, None]
        blocks.touch(np.array([row]), 9)
    content = other.copied(other.rows())
    both = content.part(np.array([0, 0]))  # twice in one part of the archive
    one.merge(both)
    (row,) = one.find(index)
    assert one.field[row, :, 0] == pytest.approx([0.1 + 0.2 * (0.75 + 0.25 * 3 / 7), 6.0])
    assert one.field[row, 1, 7] == 0.0
    assert one.color[row, 0, 0] == pytest.approx(200.0 * (0.75 + 0.25 * 3 / 7))
    assert one.votes[row, :, 0].tolist() == [6.0, 12.0]


def test_a_directory_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(FileFormatError, match=r'layers\.tsdf\.archive_directory'):
        BlockArchive(tmp_path / 'file')
