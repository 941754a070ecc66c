# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper resample``: the cloud of a file of models, with the figures of ``extract``."""

from __future__ import annotations

import json

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.files import pcd, ply
from surfel_mapper.models import read
from surfel_mapper.models.evaluation import nearest
from test.models.scenes import room, VIEW


@pytest.fixture(scope='module')
def extracted(tmp_path_factory):
    """Return a directory with a cloud and its models, and the figures of ``extract``."""
    folder = tmp_path_factory.mktemp('extracted')
    points, _ = room(160, 120, noise_per_range_sq=1.425e-3)
    rng = np.random.default_rng(0)
    bush = rng.normal((1.0, 1.5, 0.8), 0.15, (400, 3))
    points = np.concatenate([points, bush]).astype(np.float32)
    ply.write_points(folder / 'room.ply', dict(zip('xyz', points.T, strict=True)))
    place = ['--viewpoint', *map(str, VIEW), '--voxel-size', '0.03', '--json']
    return folder, points, [str(folder / 'room.ply'), '-o', str(folder / 'out'), *place]


@pytest.fixture(scope='module')
def figures(extracted):
    _, _, arguments = extracted
    capture = pytest.MonkeyPatch()
    lines = []
    capture.setattr('surfel_mapper.cli.extract.show_lines', lines.append)
    assert main(['extract', *arguments]) == 0
    capture.undo()
    return json.loads(lines[0])


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize('suffix', ['.ply', '.pcd'])
def test_the_cloud_has_the_printed_precision_and_completeness(extracted, figures, suffix):
    folder, points, _ = extracted
    models, cloud = folder / 'out' / 'models.smm', folder / f'cloud{suffix}'
    assert main(['resample', str(models), '-o', str(cloud)]) == 0
    table = (ply if suffix == '.ply' else pcd).read_points(cloud)
    samples = np.stack([table[axis] for axis in 'xyz'], axis=1).astype(np.float64)
    assert table['x'].dtype == np.float32
    precision, complete = nearest(samples, points), nearest(points.astype(np.float64), samples)
    assert rms(precision) == pytest.approx(figures['precision_rms_m'], rel=1e-3)
    assert rms(complete) == pytest.approx(figures['completeness_rms_m'], rel=1e-3)
    assert figures['bytes'] == models.stat().st_size
    assert figures['planes'] == len(read(models).planes) >= 5


def test_far_models_are_written_as_doubles(extracted, figures, tmp_path):
    folder, _, _ = extracted
    far = read(folder / 'out' / 'models.smm').translated([4e5, 5e6, 0.0])
    (tmp_path / 'far.smm').write_bytes(far.to_bytes())
    assert main(['resample', str(tmp_path / 'far.smm'), '-o', str(tmp_path / 'far.ply')]) == 0
    x = ply.read_points(tmp_path / 'far.ply')['x']
    assert x.dtype == np.float64
    assert np.abs(x - 4e5).max() < 10.0


def test_bad_files_and_spacings_are_refused(extracted, figures, tmp_path, capsys):
    folder, _, _ = extracted
    models, out = str(folder / 'out' / 'models.smm'), str(tmp_path / 'cloud.ply')
    for arguments, text in (
        ([str(folder / 'room.ply'), '-o', out], 'room.ply: expected models, which begin with'),
        ([str(folder / 'none.smm'), '-o', out], 'none.smm: No such file'),
        ([models, '-o', str(tmp_path / 'cloud.las')], 'expected a file ending in .ply or .pcd'),
        ([models, '-o', out, '--spacing', '1e-7'], 'points at this spacing, more than fit'),
    ):
        assert main(['resample', *arguments]) == 1
        assert text in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(['resample', models, '-o', out, '--spacing', '0'])
