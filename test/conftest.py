# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What the tests share: the folder of real data, and hypothesis without chance or clock."""

from __future__ import annotations

import os
from pathlib import Path

from hypothesis import settings
import pytest

# The same examples in every run; the first call of a kernel compiles it, which no deadline allows.
settings.register_profile('repeatable', derandomize=True, deadline=None)
settings.load_profile('repeatable')


@pytest.fixture(scope='session')
def data_folder() -> Path:
    """Return the folder with data/ (real scans and bags) and golden/ (reference values)."""
    folder = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    if not folder:
        pytest.skip('SURFEL_MAPPER_TEST_DATA is not set: no real data')
    return Path(folder)
