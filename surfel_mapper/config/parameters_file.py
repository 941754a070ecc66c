# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of ROS parameters: find those of this package's node among the nodes of a robot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from surfel_mapper.config.settings import flatten
from surfel_mapper.errors import ConfigError

NODE, PARAMETERS = 'surfel_mapper', 'ros__parameters'
"""Keys of a file of ROS parameters: the node's own name, and what belongs to a node."""


def ros_parameters(content: Any) -> dict[str, Any]:
    """
    Return the settings in a parameters file with or without ``ros__parameters``.

    A robot's file may hold those of several nodes; then those of ``/**`` and of the node named
    surfel_mapper are taken, in whatever namespace.

    Raises
    ------
    ConfigError
        If it is no mapping, or it is not clear which node is meant.

    """
    if not isinstance(content, Mapping):
        raise ConfigError(f'a {type(content).__name__}, expected a mapping of settings')
    sections = list(parts_of(content))
    nodes = [node for node, _ in sections if node and not node.endswith('*')]
    own = [node for node in nodes if len(nodes) == 1 or node.split('/')[-1] == NODE]
    if nodes and len(own) != 1:
        raise ConfigError(
            f'parameters of the nodes {", ".join(nodes)}, expected those of one, or of one that '
            f'is named {NODE}'
        )
    settings: dict[str, Any] = {}
    for node, values in sections:
        if not node or node.endswith('*') or node in own:
            settings.update(flatten(values))
    for_node = ('use_sim_time', 'qos_overrides.')
    return {name: value for name, value in settings.items() if not name.startswith(for_node)}


def parts_of(content: Mapping[str, Any], namespace: str = '') -> Iterator[tuple[str, Any]]:
    """Yield nodes and their parameters in a parameters file; '' and settings outside of any."""
    for name, value in content.items():
        if not holds_parameters(value):
            yield '', {name: value}
        elif PARAMETERS in value:
            yield f'{namespace}{name}', value[PARAMETERS] or {}
        else:
            yield from parts_of(value, f'{namespace}{name}/')


def holds_parameters(value: Any) -> bool:
    """Return whether a value in a parameters file is a node or a namespace of nodes."""
    return isinstance(value, Mapping) and (
        PARAMETERS in value or any(map(holds_parameters, value.values()))
    )
