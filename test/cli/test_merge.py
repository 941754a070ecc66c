# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Two maps of numpy are merged without any extra."""

import json
import sys

import numpy as np

from surfel_mapper import SurfelMap
from surfel_mapper.cli.main import main


def test_maps_of_numpy_are_merged_without_pyarrow(tmp_path, monkeypatch, capsys, caplog):
    points = np.random.default_rng(1).uniform(-3.0, 3.0, (2, 500, 3))
    both = SurfelMap(0.5)
    for number, some in enumerate(points):
        single = SurfelMap(0.5)
        single.add(some)
        single.save(tmp_path / f'{number}.npz')
        both.add(some)
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    command = ['merge', str(tmp_path / '0.npz'), str(tmp_path / '1.npz')]

    assert main([*command, '-o', str(tmp_path / 'out'), '--json']) == 0

    assert json.loads(capsys.readouterr().out)['digest'] == both.digest()
    assert SurfelMap.load(tmp_path / 'out').digest() == both.digest()
    assert 'pyarrow is not installed' in caplog.text
