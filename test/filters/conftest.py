# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixture of the tests of filters: a registry to which a test may add."""

import pytest

from surfel_mapper.filters import registry


@pytest.fixture
def own_registry(monkeypatch):
    """Restore the registry after a test."""
    registry.load_built_in()
    monkeypatch.setattr(registry, '_FILTERS', dict(registry._FILTERS))
