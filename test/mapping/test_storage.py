# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Slab: rows stay and new ones are zero when it grows, also if memory cannot be moved."""

from surfel_mapper.mapping.storage import Slab


def test_a_slab_grows_while_a_view_of_its_rows_exists():
    slab = Slab(64, 16)
    slab.array[:] = 7
    held = slab.array
    slab.grow(128)
    slab.array[:] = 9
    assert (held == 7).all()
    assert len(slab.array) == 128
