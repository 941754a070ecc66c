# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Layers: representations beside the surfels that follow the scans, behind one protocol.

The protocol is loaded when it is first asked for, because it loads the compiler; the registry is
not.
"""

from typing import Any, TYPE_CHECKING

from surfel_mapper.layers.registry import (
    enabled,
    formats,
    load,
    names,
    register,
    switches,
    unregister,
)

if TYPE_CHECKING:
    from surfel_mapper.layers.layer import (
        Contains,
        Images,
        InsertedScan,
        Layer,
        Moment,
        Publication,
        Surroundings,
    )

__all__ = [
    'Contains',
    'Images',
    'InsertedScan',
    'Layer',
    'Moment',
    'Publication',
    'Surroundings',
    'enabled',
    'formats',
    'load',
    'names',
    'register',
    'switches',
    'unregister',
]


def __getattr__(name: str) -> Any:
    """Load a name of the protocol from its module (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    from surfel_mapper.layers import layer

    return getattr(layer, name)
