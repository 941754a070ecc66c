# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Packages of the extra ``full``, which take 1.1 GB: `make test` does without them.

`make test-extras` installs them and runs the test files that import this module, so every test
that they skip elsewhere runs there.
"""

from __future__ import annotations

from importlib.util import find_spec
from types import ModuleType

import pytest


def load(name: str) -> ModuleType:
    """Import a package; skip the test if it is not installed."""
    return pytest.importorskip(name, reason=f'{name} is not installed (make test-extras)')


def has(name: str) -> bool:
    """Return whether a package is installed."""
    return find_spec(name) is not None


def needs(*names: str) -> pytest.MarkDecorator:
    """Return a mark that skips tests if a package is not installed."""
    missing = [name for name in names if not has(name)]
    return pytest.mark.skipif(
        bool(missing), reason=f'{", ".join(missing)} not installed (make test-extras)'
    )
