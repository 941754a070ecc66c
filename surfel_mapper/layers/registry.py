# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The registry of layers: their names, their classes, and the settings that switch them on.

A class is loaded when its layer is switched on: the models take 0.1 s, which a map without them
does not wait for. This module loads no compiler, so that the command line can list formats. Other
packages register layers by an entry point (docs/extending.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING

from surfel_mapper.errors import ConfigError

if TYPE_CHECKING:
    from surfel_mapper.config import Config
    from surfel_mapper.layers.layer import Layer


@dataclass(frozen=True, slots=True)
class RegisteredLayer:
    """
    How a layer is found.

    Attributes
    ----------
    name : str
        Layer.name.
    location : str
        ``module:Class``.
    switch : str
        Setting that switches it on, if true and not 0; empty: it is always on.
    formats : mapping of str to str
        The file of each format that ``write`` makes only if the user asks for it.

    """

    name: str
    location: str
    switch: str = ''
    formats: Mapping[str, str] = field(default_factory=dict)


_REGISTERED: dict[str, RegisteredLayer] = {}


def register(
    name: str, location: str, switch: str = '', formats: Mapping[str, str] | None = None
) -> None:
    """
    Register a layer; the order of registration is the order in which layers follow a scan.

    Raises
    ------
    ConfigError
        If another layer has the name.

    """
    layer = RegisteredLayer(name, location, switch, formats or {})
    first = _REGISTERED.setdefault(name, layer)
    if first.location != location:
        raise ConfigError(f'layer {name!r} of {location}: {first.location} has this name already')


def unregister(name: str) -> None:
    """Remove a layer that was registered."""
    del _REGISTERED[name]


def names() -> tuple[str, ...]:
    """Return the names of all registered layers, switched on or not."""
    return tuple(_REGISTERED)


def switches() -> tuple[str, ...]:
    """Return the settings that switch layers on."""
    return tuple(layer.switch for layer in _REGISTERED.values() if layer.switch)


def formats() -> dict[str, RegisteredLayer]:
    """Return the formats that users may ask for, with the layer that writes each."""
    return {name: layer for layer in _REGISTERED.values() for name in layer.formats}


def enabled(config: Config) -> Iterator[type[Layer]]:
    """
    Yield the classes of the layers that a configuration switches on, in their order.

    Raises
    ------
    ConfigError
        If a location holds no layer of the name.

    """
    settings = config.to_mapping()
    for registered in _REGISTERED.values():
        if not registered.switch or settings[registered.switch]:
            yield load(registered)


def load(registered: RegisteredLayer) -> type[Layer]:
    """
    Return the class of a layer.

    Raises
    ------
    ConfigError
        If its location holds no layer of the name.

    """
    from surfel_mapper.layers.layer import Layer

    module, _, name = registered.location.partition(':')
    cls = getattr(import_module(module), name, None)
    if not (isinstance(cls, type) and issubclass(cls, Layer)):
        raise ConfigError(f'layer {registered.name!r}: {registered.location} is no Layer')
    if cls.name != registered.name:
        raise ConfigError(
            f'layer {registered.name!r}: {registered.location} has the name {cls.name!r}'
        )
    return cls


register('dynamic', 'surfel_mapper.layers.dynamic_objects:DynamicObjectsLayer', 'dynamic.clear')
register('grid', 'surfel_mapper.layers.costs:CostsLayer')
register('tsdf', 'surfel_mapper.layers.distance_field:TsdfLayer', 'layers.tsdf.enabled')
register(
    'models',
    'surfel_mapper.layers.models:ModelsLayer',
    'layers.models.enabled',
    {'obj': 'models.obj', 'glb': 'models.glb'},
)
