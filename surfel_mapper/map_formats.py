# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Registration of the file formats that SurfelMap.save and SurfelMap.load use.

Formats are on a higher level than the map, which does not import them. The package registers
them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_loaders: list[Callable[[], Any]] = []


def register(load: Callable[[], Any]) -> None:
    """Register a function that loads the module of the formats when a map is saved or loaded."""
    _loaders[:] = [load]


def registered() -> Any:
    """Return the module that is registered: load_surfel_map(path), save_surfel_map(path, map)."""
    return _loaders[0]()
