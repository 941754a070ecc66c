# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Packed models: tolerance, an independent reader, the same bytes again, and hostile bytes."""

from __future__ import annotations

from dataclasses import replace
import itertools
import struct
import zlib

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.errors import FileFormatError, ModelError
from surfel_mapper.models import fit, Gaussians, MultiModel, read
from surfel_mapper.models.packing import FIXED, ModelsHeader, pack
from test.models.scenes import A, room, VIEW

STEP = A / 128.0
NO_GAUSSIANS = Gaussians(
    np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3))
)


@pytest.fixture(scope='module')
def model():
    return fit(room(160, 120, noise_per_range_sq=1.425e-3)[0], ModelsConfig(voxel_size_m=A), VIEW)


class Reader:
    """Reads a file as docs/models_format.md states it, without the package."""

    def __init__(self, data):
        (_, _, _, crc, self.number, planes, surfaces, gaussians, removed, size) = (
            struct.unpack_from('<8sHHIIIIIII', data)
        )
        _, self.voxel_m, self.step, _, _, self.thinned, letters = struct.unpack_from(
            '<qddddQH', data, 40
        )
        assert zlib.crc32(data[16:]) == crc
        self.raw, self.at = zlib.decompress(data[90 + letters :]), 0
        assert len(self.raw) == size
        total, patches = planes + surfaces + gaussians, planes + surfaces
        self.ids, self.versions = self.column(total, 'I'), self.column(total, 'I')
        self.points = self.column(total, 'Q')
        self.means = list(zip(*(self.lengths(total) for _ in range(3)), strict=True))
        self.roots = list(zip(*(self.lengths(total) for _ in range(6)), strict=True))
        self.q_xyzw = list(zip(*(self.column(patches, 'h') for _ in range(4)), strict=True))
        self.rms, self.pitches = self.lengths(patches), self.column(patches, 'd')
        self.origins = list(zip(*(self.lengths(patches) for _ in range(2)), strict=True))
        self.sizes = list(zip(*(self.column(patches, 'I') for _ in range(2)), strict=True))
        self.filled = self.cells()
        rims = [cell for cells in self.filled for cell in sorted(self.rim(cells))]
        corners, *cuts = (self.column(len(rims), 'B') for _ in range(4))
        self.corners, self.cuts = corners, list(zip(*cuts, strict=True))
        self.degrees = list(zip(*(self.column(surfaces, 'B') for _ in range(2)), strict=True))
        self.spline_pitches = self.column(surfaces, 'd')
        self.spline_origins = [self.lengths(surfaces) for _ in range(2)]
        shapes = list(zip(*(self.column(surfaces, 'I') for _ in range(2)), strict=True))
        heights = iter(self.lengths(sum(x * y for x, y in shapes)))
        self.control = [self.rows(heights, *shape) for shape in shapes]
        self.removed = self.column(removed, 'I')
        assert self.at == len(self.raw)

    def column(self, number, code):
        size = struct.calcsize(f'<{code}')
        block = self.raw[self.at : self.at + number * size]
        self.at += number * size
        whole = bytes(block[k + b * number] for k in range(number) for b in range(size))
        return struct.unpack(f'<{number}{code}', whole)

    def lengths(self, number):
        return [self.step * (n >> 1 ^ -(n & 1)) for n in self.column(number, 'Q')]

    def cells(self):
        total = sum(x * y for x, y in self.sizes)
        block = self.raw[self.at : self.at + -(-total // 8)]
        self.at += len(block)
        bits = (block[k // 8] >> 7 - k % 8 & 1 for k in range(total))
        return [
            {cell for cell in itertools.product(range(x), range(y)) if next(bits)}
            for x, y in self.sizes
        ]

    def rim(self, cells):
        steps = ((1, 0), (-1, 0), (0, 1), (0, -1))
        return {(x, y) for x, y in cells if any((x + i, y + j) not in cells for i, j in steps)}

    def rows(self, heights, num_x, num_y):
        rows, first = [], 0.0
        for _ in range(num_x):
            first += next(heights)
            rows.append([first])
            for _ in range(num_y - 1):
                rows[-1].append(rows[-1][-1] + next(heights))
        return rows


def test_an_independent_reader_agrees_within_the_tolerance(model):
    found, patches, gaussians = Reader(model.to_bytes()), model.patches, model.gaussians
    assert found.voxel_m == A
    assert found.ids == tuple([patch.id for patch in patches] + gaussians.id.tolist())
    assert sum(found.points) == found.thinned == model.num_thinned
    means = np.concatenate([[patch.mean for patch in patches], gaussians.mean])
    np.testing.assert_allclose(found.means, means, rtol=0, atol=0.5001 * STEP)
    x, y, z, w = (np.array(found.q_xyzw) / np.linalg.norm(found.q_xyzw, axis=1)[:, None]).T
    normals = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)], axis=1)
    np.testing.assert_allclose(normals, [patch.normal for patch in patches], atol=1e-4)
    for patch, cells, corner in zip(patches, found.filled, found.origins, strict=True):
        assert cells == {tuple(cell) for cell in np.argwhere(patch.grid.filled).tolist()}
        np.testing.assert_allclose(corner, patch.grid.origin, rtol=0, atol=0.5001 * STEP)
    cuts = np.concatenate([patch.grid.cuts[patch.grid.rim] for patch in patches])
    np.testing.assert_array_equal(np.array(found.cuts)[:, :2], cuts[:, :2])
    for surface, control in zip(model.surfaces, found.control, strict=True):
        np.testing.assert_allclose(control, surface.spline.control, rtol=0, atol=4.001 * STEP)
    root = np.zeros((len(gaussians), 3, 3))
    root[(slice(None), *np.tril_indices(3))] = found.roots[len(patches) :]
    again, sigma = (
        root @ root.swapaxes(1, 2),
        np.sqrt(np.trace(gaussians.covariance, 0, 1, 2).max()),
    )
    np.testing.assert_allclose(again, gaussians.covariance, rtol=0, atol=3 * STEP * sigma)


def test_reading_keeps_the_area_and_the_points_of_a_cloud(model):
    again = MultiModel.from_bytes(model.to_bytes())
    xy = np.random.default_rng(0).uniform(-3.0, 3.0, (2000, 2))
    for old, new in zip(model.patches, again.patches, strict=True):
        differs = old.grid.contains(xy) != new.grid.contains(xy)
        assert differs.mean() < 0.002
        assert (old.grid.rim == new.grid.rim).all()
    points, _ = room(160, 120, noise_per_range_sq=1.425e-3)
    before, after = model.evaluate(points), again.evaluate(points)
    assert after.precision_rms_m == pytest.approx(before.precision_rms_m, rel=0.02)
    assert after.completeness_rms_m == pytest.approx(before.completeness_rms_m, rel=0.02)


def test_models_that_were_read_give_the_same_bytes(model, tmp_path):
    (tmp_path / 'models.smm').write_bytes(model.to_bytes())
    assert read(tmp_path / 'models.smm').to_bytes() == model.to_bytes()
    assert model.size_bytes == len(model.to_bytes())


def test_none_and_degenerate_primitives_are_kept():
    empty = fit(np.empty((0, 3)), ModelsConfig(voxel_size_m=A))
    assert MultiModel.from_bytes(empty.to_bytes()).patches == []
    assert empty.size_bytes == 0
    line = np.outer(np.linspace(0.0, 1.0, 50), [1.0, 0.5, -2.0])
    one = fit(np.concatenate([line, [[9.0, 9.0, 9.0]]]), ModelsConfig(voxel_size_m=A))
    again = MultiModel.from_bytes(one.to_bytes())
    assert again.to_bytes() == one.to_bytes()
    spread = again.gaussians.covariance - one.gaussians.covariance
    assert np.abs(spread).max() < 2 * STEP * 2.5


def test_far_coordinates_are_exact_to_the_step(model):
    far = model.translated([4.2e5, 5.8e6, 100.0])
    again = MultiModel.from_bytes(far.to_bytes())
    for old, new in zip(far.patches, again.patches, strict=True):
        np.testing.assert_allclose(new.mean, old.mean, rtol=0, atol=0.501 * STEP)


def test_numbers_that_cannot_be_packed_are_refused(model):
    plane = replace(model.planes[0], mean=np.array([np.nan, 0.0, 0.0]))
    with pytest.raises(ModelError, match='nan m, expected less than'):
        replace(model, planes=[plane]).to_bytes()
    plane = replace(model.planes[0], id=2**32)
    with pytest.raises(ModelError, match='beyond 4294967295'):
        replace(model, planes=[plane]).to_bytes()


def edited(data, offset, code, value):
    """Return bytes with another value in the header, and the CRC that fits."""
    content = bytearray(data)
    struct.pack_into(f'<{code}', content, offset, value)
    struct.pack_into('<I', content, 12, zlib.crc32(content[16:]))
    return bytes(content)


def recompressed(data, change):
    """Return bytes with other columns, their size and the CRC that fits."""
    raw = bytearray(zlib.decompress(data[FIXED.size :]))
    change(raw)
    content = data[: FIXED.size] + zlib.compress(bytes(raw))
    return edited(content, 36, 'I', len(raw))


BROKEN = [
    (lambda data: b'', 'expected models, which begin with SMMODELS'),
    (lambda data: data[:60], 'expected models'),
    (lambda data: b'PK' + data[2:], 'expected models'),
    (lambda data: data[:-1], 'damaged, its CRC'),
    (lambda data: data[:200] + bytes([data[200] ^ 255]) + data[201:], 'damaged, its CRC'),
    (lambda data: edited(data, 8, 'H', 2), 'models of version 2, flags 1; this release reads'),
    (lambda data: edited(data, 10, 'H', 7), 'flags 7'),
    (lambda data: edited(data, 20, 'I', 2**32 - 1), r'not possible in models: \d+ bytes, 1\d+ '),
    (lambda data: edited(data, 28, 'I', 0), 'not possible in models: '),
    (lambda data: edited(data, 36, 'I', 2**32 - 1), 'needs 12884901885 bytes'),
    (lambda data: edited(data, 36, 'I', 10), 'expected columns of 10 bytes, and no more'),
    (lambda data: edited(data, 48, 'd', float('nan')), 'voxels of nan m'),
    (lambda data: edited(data, 56, 'd', 0.0), 'voxels of'),
    (lambda data: edited(data, 64, 'd', float('inf')), 'noise inf'),
    (lambda data: edited(data, 88, 'H', 300), 'name of the frame|incorrect header check'),
    (lambda data: recompressed(data, lambda raw: raw.append(0)), '1 bytes too many'),
    (lambda data: recompressed(data, lambda raw: raw.__setitem__(1, raw[0])), 'an id twice'),
]


@pytest.mark.parametrize(('damage', 'text'), BROKEN)
def test_damaged_and_impossible_files_are_refused_in_words(model, tmp_path, damage, text):
    path = tmp_path / 'models.smm'
    path.write_bytes(damage(model.to_bytes()))
    with pytest.raises(FileFormatError, match=text) as caught:
        read(path)
    assert str(path) in str(caught.value)


def test_a_file_of_few_bytes_cannot_ask_for_many_cells(model):
    """Two planes whose grids have 2^30 cells, all empty, compress to a megabyte."""
    plane = model.planes[0]
    data = pack(ModelsHeader(voxel_size_m=A), ([plane], []), NO_GAUSSIANS)
    raw = bytearray(zlib.decompress(data[FIXED.size :]))
    x, y = plane.grid.filled.shape
    cells = -(-x * y // 8) + 4 * int(plane.grid.rim.sum())
    start = len(raw) - cells - 8
    assert struct.unpack_from('<II', raw, start) == (x, y)
    raw[start:] = struct.pack('<II', 2**14, 2**13) + bytes(2**24)
    content = data[: FIXED.size] + zlib.compress(bytes(raw))
    with pytest.raises(FileFormatError, match='134217728 cells: needs'):
        MultiModel.from_bytes(edited(content, 36, 'I', len(raw)))


@pytest.mark.parametrize('seed', range(40))
def test_noise_in_the_columns_is_read_or_refused(model, seed):
    rng = np.random.default_rng(seed)

    def scramble(raw):
        for k in rng.integers(0, len(raw), 1 + seed // 4):
            raw[k] = int(rng.integers(256))

    try:
        again = MultiModel.from_bytes(recompressed(model.to_bytes(), scramble))
    except FileFormatError:
        return
    assert len(again.patches) == len(model.patches)
    assert again.to_bytes()


def test_other_files_are_refused(tmp_path):
    with pytest.raises(FileFormatError, match='No such file'):
        read(tmp_path / 'none.smm')
    with pytest.raises(FileFormatError, match='irectory'):
        read(tmp_path)
