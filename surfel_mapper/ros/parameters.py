# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ROS parameters from the configuration, and back.

The configuration checks what a user set before anything is declared: it knows all names and
bounds, so a typing mistake gets the nearest name instead of being passed over, which is what ROS
does with overrides that nobody declares. What is then declared is the value that was checked.
"""

from __future__ import annotations

from collections.abc import Iterable
import math
import sys
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from surfel_mapper.config import Config, Declaration, declarations, near

QOS_OVERRIDES = 'qos_overrides.'
"""Parameters of this prefix are declared by rclpy with the topic that they are for."""

INT64_MAX = 2**63 - 1

LISTS = {float: Parameter.Type.DOUBLE_ARRAY, str: Parameter.Type.STRING_ARRAY}
"""Types of parameters by what a list holds."""


def declare_settings(node: Node) -> Config:
    """
    Declare every setting as a parameter of a node; return the configuration they make.

    Raises
    ------
    ConfigError
        If the user set a parameter that is no setting, or to a value that it cannot have.
        Nothing is declared then.

    """
    config = Config.from_mapping(overrides(node))
    values = config.to_mapping()
    for declared in declarations():
        declare(node, declared, values[declared.name])
    return config


def overrides(node: Node) -> dict[str, Any]:
    """Return what the user set, without what is meant for rclpy."""
    found = node._parameter_overrides  # rclpy offers overrides in no other way
    return {
        name: [] if parameter.value is None else parameter.value  # an empty list has no type
        for name, parameter in found.items()
        if not name.startswith(QOS_OVERRIDES) and not node.has_parameter(name)
    }


def declare(node: Node, declared: Declaration, value: Any) -> None:
    """Declare one setting with a value that was checked."""
    if not isinstance(value, tuple):
        node.declare_parameter(declared.name, value, descriptor(declared), ignore_override=True)
        return
    # rclpy takes an empty list for one of bytes, so the type is declared first, then the value,
    # and in the end whether it can be changed.
    kind = LISTS[declared.items]
    node.declare_parameter(declared.name, kind, ParameterDescriptor(), ignore_override=True)
    node.set_parameters([Parameter(declared.name, kind, list(value))])
    final = descriptor(declared)
    final.type = kind.value
    node.set_descriptor(declared.name, final)


def descriptor(declared: Declaration) -> ParameterDescriptor:
    """Return what ``ros2 param describe`` shows of a setting."""
    low, high = declared.low, declared.high
    found = ParameterDescriptor(
        description=declared.meaning,
        read_only=not declared.live,
        additional_constraints=f'one of {", ".join(declared.choices)}' if declared.choices else '',
    )
    if isinstance(declared.default, float):
        largest = sys.float_info.max
        found.floating_point_range = [
            FloatingPointRange(
                from_value=-largest if math.isinf(low) else low,
                to_value=largest if math.isinf(high) else high,
            )
        ]
    elif isinstance(declared.default, int) and not isinstance(declared.default, bool):
        found.integer_range = [
            IntegerRange(
                from_value=-INT64_MAX if math.isinf(low) else int(low),
                to_value=INT64_MAX if math.isinf(high) else int(high),
            )
        ]
    return found


def changed_config(config: Config, parameters: Iterable[Parameter]) -> Config:
    """
    Return a configuration with some parameters changed; others than settings are passed over.

    Raises
    ------
    ConfigError
        If a value is refused.

    """
    names = {declared.name for declared in declarations()}
    return config.replace({p.name: p.value for p in parameters if p.name in names})


def refusal(node: Node, parameters: Iterable[Parameter]) -> str:
    """Return why parameters cannot be set on a running node, whatever their values; or nothing."""
    for parameter in parameters:
        name = parameter.name
        if not node.has_parameter(name):
            known = [declared.name for declared in declarations()]
            return f'{name}: no such setting{near(name, known)}'
        if node.describe_parameter(name).read_only:
            return f'{name}: read-only, cannot change while running; set it at the start'
    return ''


def as_declared(parameter: Parameter) -> Parameter:
    """Return a parameter with a float for a whole number where a float is declared."""
    floats = {declared.name for declared in declarations() if isinstance(declared.default, float)}
    if parameter.name in floats and parameter.type_ == Parameter.Type.INTEGER:
        return Parameter(parameter.name, value=float(parameter.value))
    return parameter
