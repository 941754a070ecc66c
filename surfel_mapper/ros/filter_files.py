# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The files of filters that peers may name while the node runs, in the setting ``filters``.

Any process in the ROS domain can set it. A file is read only inside of one directory, and a
refusal states the file and the kind of fault, never text of the file, which may be any file of the
user: answers and the log (/rosout) are sent to peers.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from surfel_mapper.config import Config, read_yaml
from surfel_mapper.errors import ConfigError
from surfel_mapper.filters.chain import Chain
from surfel_mapper.ros.map_files import is_inside

PARAMS_FILE = '--params-file'


class FilterFiles:
    """
    The files that ``filters`` may name while a node runs.

    Parameters
    ----------
    config : Config
        The settings of the start: their chain may be anywhere.
    ros_args : sequence of str
        The command line; without ``input.filters_directory`` its first parameter file gives the
        directory.

    """

    def __init__(self, config: Config, ros_args: Sequence[str]) -> None:
        self._first = config.filters
        named = config.input.filters_directory
        files = [value for name, value in pairwise(ros_args) if name == PARAMS_FILE]
        if not named and files:
            named = str(Path(files[0]).parent)
        self._directory = Path(named).expanduser().absolute() if named else None

    def path(self, value: str) -> str:
        """
        Return the path of the chain that a value names; empty for none.

        Raises
        ------
        ConfigError
            If the file may not be read.

        """
        if not value or value == self._first:
            return value
        if self._directory is None:
            raise ConfigError(
                'filters: input.filters_directory or a parameter file has to give the directory '
                'of chains at the start, to change it while running'
            )
        name, mark, keys = value.partition('#')
        path = self._directory / name
        if '\0' in name or not is_inside(self._directory, path):
            raise ConfigError(f'filters: {value!r:.200} is not inside {self._directory}')
        return f'{path}{mark}{keys}'


def check_chain(path: str) -> None:
    """Raise ConfigError with the kind of fault if a file holds no valid chain."""
    if fault := fault_of(path):
        raise ConfigError(f'filters: {path!r:.500}: {fault}')


def fault_of(path: str) -> str:
    """Return the kind of fault of a chain, without text of its file; empty if it is valid."""
    try:
        read_yaml(path.partition('#')[0], as_text=True)
        Chain.load(path)
    except OSError as error:
        return f'cannot be read: {error.strerror}'
    except ConfigError:
        return 'no valid chain of filters; `surfel-mapper filter` with this file states the fault'
    except ValueError:
        return 'not YAML'
    return ''
