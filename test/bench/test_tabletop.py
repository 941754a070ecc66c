# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The error of boundaries and the picture of patches, on frames whose answer is known."""

from __future__ import annotations

import numpy as np
from PIL import Image

from test.bench.tabletop import boundary_error_mm, SHAPE, write_picture


def test_boundary_error_is_the_shift_of_a_patch(tmp_path):
    rows, columns = np.indices(SHAPE)
    points = np.stack([columns, rows, np.full(SHAPE, 1000)], axis=-1).reshape(-1, 3) * 1e-3
    labels = np.where((columns >= 100) & (columns < 300), 2, 1).reshape(-1)
    exact, shifted = labels - 1, np.roll(labels - 1, 5, axis=0)
    assert boundary_error_mm(points.astype(np.float32), labels, exact) == 0.0
    error = boundary_error_mm(points.astype(np.float32), labels, shifted)
    # pixels of 1 mm; the left and right sides are 5 mm apart, top and bottom nearly agree
    assert 2.0 < error < 5.0
    write_picture(tmp_path / 'frames.png', [(exact, shifted)] * 2)
    picture = np.asarray(Image.open(tmp_path / 'frames.png'))
    assert picture.shape == (SHAPE[0], SHAPE[1], 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 2
