# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Libraries that are loaded when they are needed, and may be missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from surfel_mapper.errors import DependencyError


def library(name: str, purpose: str, package: str) -> Any:
    """
    Return a module; raise DependencyError with the command to install it.

    Parameters
    ----------
    name : str
        The module.
    purpose : str
        Its use, as in "reads E57".
    package : str
        Argument of ``pip install``: a package, or this one with an extra.

    """
    try:
        return import_module(name)
    except ImportError as error:
        raise DependencyError(
            f'{name} cannot be loaded ({error}). It {purpose}; install it with `pip install '
            f'{package}`'
        ) from error
