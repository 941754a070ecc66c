# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Settings of the configuration as options: ``--config``, ``--set`` and ``--voxel-size``.

Options override the file, and of two options for one setting the last counts. Values are read and
checked as those of a YAML file. The node has no such options, because ROS has its own:
``--params-file`` and ``-p``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, TYPE_CHECKING

from surfel_mapper.cli._arguments import real

if TYPE_CHECKING:
    from surfel_mapper.config import Config


def add_settings(parser: argparse.ArgumentParser, config_help: str, *, maps: bool = True) -> None:
    """
    Declare the options for settings.

    Parameters
    ----------
    parser : ArgumentParser
        Parser of a verb.
    config_help : str
        Help of ``--config``.
    maps : bool
        Whether the verb maps, and so takes a voxel size.

    """
    add = parser.add_argument_group('settings').add_argument
    add('--config', type=Path, metavar='FILE', help=config_help)
    overrides: dict[str, Any] = {'dest': 'settings', 'action': 'append', 'default': []}
    action = add(
        '--set',
        type=assignment,
        metavar='NAME=VALUE',
        help='setting that overrides --config, as map.min_points=3; repeatable '
        '(`surfel-mapper info --parameters` lists all)',
        **overrides,
    )
    action.completer = setting_names  # type: ignore[attr-defined]
    if maps:
        add(
            '--voxel-size',
            type=voxel_size,
            metavar='M',
            help='edge of a voxel, m; the setting map.voxel_size_m (0.5)',
            **overrides,
        )


def assignment(text: str) -> tuple[str, Any]:
    """Return name and value of NAME=VALUE, the value as YAML has it."""
    from surfel_mapper.config import parse_yaml

    name, equals, value = text.partition('=')
    if not name or not equals:
        raise argparse.ArgumentTypeError(f'{text!r}, expected NAME=VALUE')
    try:
        return name.strip(), parse_yaml(value)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f'{text!r}: not YAML: {error}') from error


def voxel_size(text: str) -> tuple[str, float]:
    """Return name and value of the setting of the voxel size."""
    try:
        return 'map.voxel_size_m', real(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f'{text!r}, expected a number') from error


def setting_names(prefix: str, **_: Any) -> list[str]:
    """Return the names of settings that a shell may complete, each with its equals sign."""
    from surfel_mapper.config import Config

    return [f'{name}=' for name in Config().to_mapping() if name.startswith(prefix)]


def configured(args: argparse.Namespace) -> Config:
    """Return the configuration that the options ask for; raise ConfigError if it is refused."""
    from surfel_mapper.config import load_config

    return load_config(args.config).replace(dict(args.settings))
