# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ROS parameters declared from the configuration, and the configuration set by ROS parameters.

The configuration checks all overrides before any parameter is declared. ROS silently ignores
overrides of parameters that are not declared; here a misspelt name is an error that suggests the
nearest one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
import math
import sys
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from surfel_mapper.config import checked, Config, Declaration, declarations, near, read_yaml
from surfel_mapper.config.parameters_file import parts_of
from surfel_mapper.errors import ConfigError
from surfel_mapper.ros.filter_files import PARAMS_FILE

QOS_OVERRIDES = 'qos_overrides.'
"""rclpy declares parameters of this prefix when it subscribes to their topics."""

INT64_MAX = 2**63 - 1

MAX_SUGGESTIONS = 10
"""Unknown names of a request for which a similar one is searched; a search takes 2 ms."""

FLOATS = {
    Parameter.Type.INTEGER: Parameter.Type.DOUBLE,
    Parameter.Type.INTEGER_ARRAY: Parameter.Type.DOUBLE_ARRAY,
}
"""Types of integers, and the types that they are taken for where floats are declared."""

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
    values = node._parameter_overrides  # rclpy has no public access to overrides
    return {
        name: [] if parameter.value is None else parameter.value  # an empty list has no type
        for name, parameter in values.items()
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
    result = ParameterDescriptor(
        description=declared.meaning,
        read_only=not declared.live,
        additional_constraints=f'one of {", ".join(declared.choices)}' if declared.choices else '',
    )
    if isinstance(declared.default, float):
        largest = sys.float_info.max
        result.floating_point_range = [
            FloatingPointRange(
                from_value=-largest if math.isinf(low) else low,
                to_value=largest if math.isinf(high) else high,
            )
        ]
    elif isinstance(declared.default, int) and not isinstance(declared.default, bool):
        result.integer_range = [
            IntegerRange(
                from_value=-INT64_MAX if math.isinf(low) else int(low),
                to_value=INT64_MAX if math.isinf(high) else int(high),
            )
        ]
    return result


def settings_among(parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Return the values of those parameters that are settings; those of rclpy are none."""
    names = {declared.name for declared in declarations()}
    return {p.name: p.value for p in parameters if p.name in names}


def refusals(node: Node, parameters: Sequence[Parameter]) -> dict[str, str]:
    """
    Return why parameters cannot be set on a running node, by name.

    They are unknown, read-only, of another type or out of bounds. The nearest names of unknown
    ones are searched for MAX_SUGGESTIONS of a request, since a search takes milliseconds.
    """
    settings = {declared.name: declared for declared in declarations()}
    reasons: dict[str, str] = {}
    num_unknown = 0
    for parameter in parameters:
        name = parameter.name
        if not node.has_parameter(name):
            num_unknown += 1
            suggestion = near(name, settings) if num_unknown <= MAX_SUGGESTIONS else ''
            reasons[name] = f'{name}: no such setting{suggestion}'
        elif node.describe_parameter(name).read_only:
            reasons[name] = f'{name}: read-only, cannot change while running; set it at the start'
        elif name in settings:
            try:
                checked(name, parameter.value, settings[name])
            except ConfigError as error:
                reasons[name] = str(error)
            else:
                if parameter.type_.value != node.describe_parameter(name).type:
                    reasons[name] = f'{name}: an empty list of another type'
    return reasons


def as_declared(parameter: Parameter) -> Parameter:
    """Return the parameter as floats if it is declared so and given as integers."""
    kind = FLOATS.get(parameter.type_)
    if kind is None or parameter.name not in float_settings():
        return parameter
    value = parameter.value
    is_list = kind is Parameter.Type.DOUBLE_ARRAY
    return Parameter(parameter.name, kind, [float(v) for v in value] if is_list else float(value))


def float_settings() -> set[str]:
    """Return the names of the settings that are floats, or lists of them."""
    return {
        declared.name
        for declared in declarations()
        if (declared.items if declared.is_list else type(declared.default)) is float
    }


def unread_files(ros_args: Sequence[str], node: str) -> Iterator[str]:
    """Yield a text for each parameter file of a command line that has none of a node."""
    for option, path in pairwise(ros_args):
        if option == PARAMS_FILE:
            try:
                names = [name for name, _ in parts_of(read_yaml(path, as_text=True)) if name]
            except (OSError, ValueError) as error:
                yield f'{path}: whether it has parameters of {node} is not known: {error}'
                continue
            if not any(name.endswith('*') or name.split('/')[-1] == node for name in names):
                yield f'{path}: parameters of {", ".join(names)}, none of {node}: none is used'
