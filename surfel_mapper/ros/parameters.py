# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ROS parameters declared from the configuration, and the configuration set by ROS parameters.

The configuration checks all overrides before any parameter is declared. ROS silently ignores
overrides of parameters that are not declared; here a misspelt name is an error that suggests the
nearest one.
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
"""rclpy declares parameters of this prefix when it subscribes to their topics."""

INT64_MAX = 2**63 - 1

LISTS = {float: Parameter.Type.DOUBLE_ARRAY, str: Parameter.Type.STRING_ARRAY}
"""Parameter types of lists, by the type of their items."""


def declare_settings(node: Node) -> Config:
    """
    Declare every setting as a parameter of a node; return the configuration.

    Raises
    ------
    ConfigError
        If the user set an unknown parameter, or a value out of bounds. Nothing is declared then.

    """
    config = Config.from_mapping(overrides(node))
    values = config.to_mapping()
    for declared in declarations():
        declare(node, declared, values[declared.name])
    return config


def overrides(node: Node) -> dict[str, Any]:
    """Return the parameters set by the user, without those of rclpy."""
    found = node._parameter_overrides  # rclpy has no public access to overrides
    return {
        name: [] if parameter.value is None else parameter.value  # an empty list has no type
        for name, parameter in found.items()
        if not name.startswith(QOS_OVERRIDES) and not node.has_parameter(name)
    }


def declare(node: Node, declared: Declaration, value: Any) -> None:
    """Declare one setting with its checked value."""
    if not isinstance(value, tuple):
        node.declare_parameter(declared.name, value, descriptor(declared), ignore_override=True)
        return
    # rclpy takes an empty list for one of bytes, so first the type is declared, then the value
    # set, and then the parameter made read-only.
    kind = LISTS[declared.items]
    node.declare_parameter(declared.name, kind, ParameterDescriptor(), ignore_override=True)
    node.set_parameters([Parameter(declared.name, kind, list(value))])
    final = descriptor(declared)
    final.type = kind.value
    node.set_descriptor(declared.name, final)


def descriptor(declared: Declaration) -> ParameterDescriptor:
    """Return the descriptor of a setting, which ``ros2 param describe`` prints."""
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


def settings_among(parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Return the values of those parameters that are settings; those of rclpy are none."""
    names = {declared.name for declared in declarations()}
    return {p.name: p.value for p in parameters if p.name in names}


def refusal(node: Node, parameters: Iterable[Parameter]) -> str:
    """Return why parameters cannot be set on a running node: unknown or read-only; else empty."""
    for parameter in parameters:
        name = parameter.name
        if not node.has_parameter(name):
            known = [declared.name for declared in declarations()]
            return f'{name}: no such setting{near(name, known)}'
        if node.describe_parameter(name).read_only:
            return f'{name}: read-only, cannot change while running; set it at the start'
    return ''


def as_declared(parameter: Parameter) -> Parameter:
    """Return the parameter as a float if it is declared as one and given as an integer."""
    floats = {declared.name for declared in declarations() if isinstance(declared.default, float)}
    if parameter.name in floats and parameter.type_ == Parameter.Type.INTEGER:
        return Parameter(parameter.name, value=float(parameter.value))
    return parameter
