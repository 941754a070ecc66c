# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Registration of the file formats of SurfelMap.save and load, and of the messages of Surfels.

Files and messages are on a higher level than the map, which does not import them. The package
registers their modules.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_loaders: dict[str, Callable[[], Any]] = {}


def register(kind: str, load: Callable[[], Any]) -> None:
    """Register the function that loads the module of ``files`` or ``messages`` when needed."""
    _loaders[kind] = load


def registered(kind: str) -> Any:
    """
    Return a module that is registered.

    ``files`` has load_surfel_map(path) and save_surfel_map(path, map), ``messages`` has
    surfels_in(msg).
    """
    return _loaders[kind]()
