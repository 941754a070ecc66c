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
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from surfel_mapper.config import Config
    from surfel_mapper.config.settings import Stage

T = TypeVar('T', bound='Stage')

SET_HELP = (
    'setting that overrides --config, as map.min_points=3; repeatable '
    '(`surfel-mapper info --parameters` lists all)'
)

MAP_SHORTCUTS = {
    '--voxel-size': (
        'map.voxel_size_m',
        'edge of a voxel, m; the setting map.voxel_size_m (0.5; of depth images 0.08)',
    )
}
"""Options of verbs that map."""


def add_settings(
    parser: argparse.ArgumentParser,
    config_help: str = '',
    *,
    shortcuts: Mapping[str, tuple[str, str]] = MAP_SHORTCUTS,
    set_help: str = SET_HELP,
) -> None:
    """
    Declare the options for settings.

    Parameters
    ----------
    parser : ArgumentParser
        Parser of a verb.
    config_help : str
        Help of ``--config``; without it there is no such option.
    shortcuts : mapping of str to (str, str)
        Options that set a number of their own, each with the setting and its help.
    set_help : str
        Help of ``--set``.

    """
    add = parser.add_argument_group('settings').add_argument
    if config_help:
        add('--config', type=Path, metavar='FILE', help=config_help)
    overrides: dict[str, Any] = {'dest': 'settings', 'action': 'append', 'default': []}
    action = add(
        '--set',
        type=assignment,
        metavar='NAME=VALUE',
        help=set_help,
        **overrides,
    )
    action.completer = setting_names  # type: ignore[attr-defined]
    for option, (name, text) in shortcuts.items():
        add(option, type=partial(number_of, name), metavar='NUMBER', help=text, **overrides)


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


def number_of(name: str, text: str) -> tuple[str, float]:
    """Return name and value of a setting that is a number."""
    try:
        return name, float(text)
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


def configured_stage(args: argparse.Namespace, stage: type[T]) -> T:
    """Return a stage that is not part of the configuration, with the settings of the options."""
    from surfel_mapper.config.settings import near, settings_of, stage_name
    from surfel_mapper.errors import ConfigError

    keys = {declared.name: declared.key for declared in settings_of(stage, stage_name(stage))}
    settings = dict(args.settings)
    for name in settings:
        if name not in keys:
            raise ConfigError(f'{name}: no such setting{near(name, keys)}')
    return stage(**{keys[name]: value for name, value in settings.items()})
