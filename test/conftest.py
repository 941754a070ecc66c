# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the tests share.

The folder of real data, hypothesis without chance or clock, and which tests stay together where
several processes run them.
"""

from __future__ import annotations

import os
from pathlib import Path

from hypothesis import HealthCheck, settings
import pytest

# The same examples in every run; the first call of a kernel compiles it, which no deadline allows,
# and a machine that is busy with other things is no fault of a test.
settings.register_profile(
    'repeatable',
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile('repeatable')

HERE = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist looks for the marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep together what shares a node, or hears the nodes of others: all of ROS; else a file."""
    for item in items:
        path = item.path.relative_to(HERE)
        group = path.parts[0] if path.parts[0] == 'ros' else path.as_posix()
        item.add_marker(pytest.mark.xdist_group(group))


@pytest.fixture(scope='session')
def data_folder() -> Path:
    """Return the folder with data/ (real scans and bags) and golden/ (reference values)."""
    folder = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    if not folder:
        pytest.skip('SURFEL_MAPPER_TEST_DATA is not set: no real data')
    return Path(folder)
