# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Surfels in LAS and LAZ, as laspy reads them, far from zero too."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper import SurfelMap
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.scan_files import read_scan

laspy = pytest.importorskip('laspy', reason='laspy is not installed (extra las)')

UTM = np.array([400_384.0, 5_400_576.0, 256.0])


def coloured(origin_m=UTM):
    rng = np.random.default_rng(0)
    surfel_map = SurfelMap(0.5, columns=('intensity', 'rgb'), origin_m=origin_m)
    points = rng.uniform(-5.0, 5.0, (20_000, 3)) * [1.0, 1.0, 0.02]
    columns = {
        'intensity': rng.uniform(0.0, 200.0, len(points)).astype(np.float32),
        'rgb': rng.integers(0, 256, (len(points), 3)).astype(np.uint8),
    }
    surfel_map.add(points, columns=columns)
    return surfel_map


@pytest.mark.parametrize('suffix', ['.las', '.laz'])
def test_surfels_come_back_with_their_normals_and_channels(tmp_path, suffix):
    surfel_map = coloured()
    path = tmp_path / f'map{suffix}'
    assert surfel_map.save(path) == surfel_map.digest()

    found, surfels = laspy.read(str(path)), surfel_map.surfels()
    places = np.stack([found.x, found.y, found.z], axis=1)
    np.testing.assert_allclose(places, surfels.position + UTM, rtol=0, atol=0.6e-4)
    normal = np.stack([found['nx'], found['ny'], found['nz']], axis=1)
    np.testing.assert_array_equal(normal, surfels.normal.astype(np.float32))
    for name in ('num_points', 'num_scans', 'thickness', 'normal_sigma', 'radius', 'size'):
        expected = getattr(surfels, name).astype(found[name].dtype)
        np.testing.assert_array_equal(found[name], expected)
    np.testing.assert_allclose(found.intensity, surfels.channels['intensity'], atol=0.5)
    np.testing.assert_allclose(found.red / 257.0, surfels.channels['red'], atol=0.01)


def test_the_file_is_smaller_when_packed(tmp_path):
    surfel_map = coloured()
    for suffix in ('.las', '.laz'):
        surfel_map.save(tmp_path / f'map{suffix}')
    assert (tmp_path / 'map.laz').stat().st_size < 0.8 * (tmp_path / 'map.las').stat().st_size


def test_an_empty_map_and_our_own_reader(tmp_path):
    SurfelMap(0.5).save(tmp_path / 'empty.las')
    assert len(laspy.read(str(tmp_path / 'empty.las'))) == 0
    coloured().save(tmp_path / 'map.las')
    points, _ = read_scan(tmp_path / 'map.las')
    np.testing.assert_allclose(points, coloured().surfels().position + UTM, rtol=0, atol=0.6e-4)


def test_surfels_beyond_the_integers_of_the_format_are_refused(tmp_path):
    surfel_map = SurfelMap(0.5)
    surfel_map.add([[0.0, 0.0, 0.0], [500_000.0, 0.0, 0.0]])
    with pytest.raises(FileFormatError, match=r'map\.las: surfels farther apart than 214 km'):
        surfel_map.save(tmp_path / 'map.las')
