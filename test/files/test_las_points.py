# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Points of LAS as laspy writes them: columns, withheld points, and units of coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.scan_files import read_scan

laspy = pytest.importorskip('laspy', reason='laspy is not installed (extra las)')

N = 10
PLACES = np.random.default_rng(1).integers(0, 100_000, (N, 3)) / 1000.0
US_FOOT_M = 1200.0 / 3937.0


def written(path, *, point_format=6, version='1.4', vlrs=(), epsg=None, change=None):
    """Write ten points in steps of 1 mm; return the path."""
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales = np.full(3, 0.001)
    header.vlrs.extend(vlrs)
    if epsg is not None:
        pyproj = pytest.importorskip('pyproj', reason='pyproj is not installed (extra las)')
        header.add_crs(pyproj.CRS.from_user_input(epsg))
    las = laspy.LasData(header)
    las.x, las.y, las.z = PLACES.T
    if change is not None:
        change(las)
    las.write(str(path))
    return path


def geo_keys(**values):
    """Return GeoTIFF's keys of the kind of coordinates (1024) and of units (3076, 4099)."""
    vlr = laspy.vlrs.known.GeoKeyDirectoryVlr()
    rows = [(int(key[1:]), 0, 1, value) for key, value in values.items()]
    vlr.parse_record_data(np.array([(1, 1, 0, len(rows)), *rows], '<u2').tobytes())
    return [vlr]


@pytest.mark.parametrize('point_format', [3, 6, 7])
@pytest.mark.parametrize('suffix', ['.las', '.LAZ'])
def test_attributes_and_extra_columns_are_columns(tmp_path, point_format, suffix):
    def fill(las):
        las.add_extra_dim(laspy.ExtraBytesParams('amplitude', 'f4'))
        las['amplitude'] = np.arange(N) / 4.0
        las.classification = np.arange(N) % 7
        las.return_number = 1 + np.arange(N) % 3
        las.number_of_returns = np.full(N, 3)

    points, columns = read_scan(
        written(tmp_path / f'a{suffix}', point_format=point_format, change=fill)
    )

    np.testing.assert_allclose(points, PLACES, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(columns['classification'], np.arange(N) % 7)
    np.testing.assert_array_equal(columns['return_number'], 1 + np.arange(N) % 3)
    np.testing.assert_array_equal(columns['number_of_returns'], np.full(N, 3))
    np.testing.assert_array_equal(columns['amplitude'], np.arange(N) / 4.0)


@pytest.mark.parametrize('point_format', [0, 6])
def test_withheld_points_are_left_out(tmp_path, point_format, caplog):
    caplog.set_level('INFO')

    def withhold(las):
        las.withheld = np.arange(N) % 2
        las.classification = np.full(N, 2)

    path = written(tmp_path / 'a.las', point_format=point_format, change=withhold)
    points, columns = read_scan(path)

    np.testing.assert_allclose(points, PLACES[::2], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(columns['classification'], np.full(5, 2))
    assert 'a.las: 5 points are withheld and left out' in caplog.text


@pytest.mark.parametrize(
    ('vlrs', 'epsg', 'factors'),
    [
        ({'k1024': 1, 'k3076': 9001}, None, (1.0, 1.0)),
        ({'k1024': 1, 'k3076': 9002}, None, (0.3048, 0.3048)),
        ({'k1024': 1, 'k3076': 9003, 'k4099': 9001}, None, (US_FOOT_M, 1.0)),
        ({}, 'EPSG:2225', (US_FOOT_M, US_FOOT_M)),
        ({}, 'EPSG:2225+5703', (US_FOOT_M, 1.0)),
        ({}, 'EPSG:32632', (1.0, 1.0)),
    ],
)
def test_units_of_the_coordinate_system_are_converted_to_metres(
    tmp_path, caplog, vlrs, epsg, factors
):
    path = written(tmp_path / 'a.las', vlrs=geo_keys(**vlrs) if vlrs else (), epsg=epsg)

    points, _ = read_scan(path)

    horizontal, vertical = factors
    np.testing.assert_allclose(points, PLACES * [horizontal, horizontal, vertical], atol=1e-9)
    assert ('are converted to metres' in caplog.text) == (factors != (1.0, 1.0))


@pytest.mark.parametrize(('vlrs', 'epsg'), [({'k1024': 2}, None), ({}, 'EPSG:4326')])
def test_degrees_are_refused(tmp_path, vlrs, epsg):
    path = written(tmp_path / 'a.las', vlrs=geo_keys(**vlrs) if vlrs else (), epsg=epsg)

    with pytest.raises(FileFormatError, match=r'a\.las: longitudes and latitudes in degrees'):
        read_scan(path)


def test_an_unknown_unit_is_named(tmp_path, caplog):
    path = written(tmp_path / 'a.las', vlrs=geo_keys(k1024=1, k3076=9036))

    points, _ = read_scan(path)

    np.testing.assert_allclose(points, PLACES, rtol=0, atol=1e-9)
    assert 'metres are assumed' in caplog.text


@pytest.mark.parametrize('suffix', ['.las', '.laz'])
@pytest.mark.parametrize('lacking', [1, 30, 150])
def test_files_that_are_cut_off_are_refused(tmp_path, suffix, lacking):
    path = written(tmp_path / f'a{suffix}')  # 30 bytes a point if not packed
    path.write_bytes(path.read_bytes()[:-lacking])

    with pytest.raises(FileFormatError, match=r'truncated|damaged, or of another'):
        read_scan(path)
