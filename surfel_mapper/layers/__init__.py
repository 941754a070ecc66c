# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Layers: representations beside the surfels that follow the scans, behind one protocol.

The protocol is loaded when it is first asked for, because it loads the compiler; the registry is
not.
"""

from typing import Any, TYPE_CHECKING

from surfel_mapper.layers.registry import enabled as enabled
from surfel_mapper.layers.registry import formats as formats
from surfel_mapper.layers.registry import load as load
from surfel_mapper.layers.registry import names as names
from surfel_mapper.layers.registry import register as register
from surfel_mapper.layers.registry import switches as switches
from surfel_mapper.layers.registry import unregister as unregister

if TYPE_CHECKING:
    from surfel_mapper.layers.layer import Contains as Contains
    from surfel_mapper.layers.layer import Images as Images
    from surfel_mapper.layers.layer import InsertedScan as InsertedScan
    from surfel_mapper.layers.layer import Layer as Layer
    from surfel_mapper.layers.layer import Moment as Moment
    from surfel_mapper.layers.layer import Publication as Publication
    from surfel_mapper.layers.layer import Surroundings as Surroundings


def __getattr__(name: str) -> Any:
    """Load a name of the protocol from its module (PEP 562)."""
    if name.startswith('_') or name == 'layer':  # the module below
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    from surfel_mapper.layers import layer

    return getattr(layer, name)
