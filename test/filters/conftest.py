# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What tests of filters share: a registry that they may add to."""

import pytest

from surfel_mapper.filters import registry


@pytest.fixture
def own_registry(monkeypatch):
    """Leave the registry as it was, whatever a test registers."""
    registry.load_built_in()
    monkeypatch.setattr(registry, '_FILTERS', dict(registry._FILTERS))
