# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Opening one file of a bag: through its index if that is complete, else by salvage.

rosbags raises nearly any exception on damaged files (AssertionError, KeyError, struct.error, ...);
each becomes a BagError here. It also silently skips chunks of mcap that have no index; such files
are salvaged too.
"""

from __future__ import annotations

from pathlib import Path
import struct

from surfel_mapper.bags._rosbags import is_fully_indexed, open_indexed, Storage
from surfel_mapper.bags.mcap import SalvagedMcap
from surfel_mapper.bags.paths import is_ros1, unpacked_name
from surfel_mapper.bags.ros1 import SalvagedRos1
from surfel_mapper.bags.salvage import SalvagedFile
from surfel_mapper.bags.sqlite import is_short, SalvagedSqlite
from surfel_mapper.errors import BagError, DependencyError

SALVAGE: dict[str, type[SalvagedFile]] = {
    '.mcap': SalvagedMcap,
    '.db3': SalvagedSqlite,
    '.bag': SalvagedRos1,
}
"""Reader without an index for each kind of file."""

REPAIR = {'.mcap': 'mcap recover', '.db3': 'sqlite3 FILE .recover', '.bag': 'rosbag reindex'}
"""The tool that may repair a damaged file."""


def open_storage(path: Path, named: Path | None = None) -> Storage:
    """
    Open one file of a bag.

    Parameters
    ----------
    path : Path
        The file.
    named : Path, optional
        Name in errors, if the file is an unpacked copy.

    Raises
    ------
    BagError
        If it cannot be read and holds no whole message either.

    """
    named = named or path
    try:
        storage = open_indexed(path, ros1=is_ros1(path))
    except DependencyError:
        raise
    except Exception as error:
        salvaged = salvage(path, named)
        if salvaged is None:
            raise damaged(named, 'cannot be read', error) from error
        return salvaged
    is_whole = not is_short(path) if suffix(path) == '.db3' else is_fully_indexed(storage)
    salvaged = None if is_whole else salvage(path, named)
    if salvaged is None:
        return storage
    storage.close()
    return salvaged


def salvage(path: Path, named: Path) -> SalvagedFile | None:
    """Return a file read without its index; None if it is of another kind or without messages."""
    kind = SALVAGE[suffix(path)]
    with open(path, 'rb') as file:
        if file.read(len(kind.MAGIC)) != kind.MAGIC:
            return None
    try:
        salvaged = kind(path)
    except (ValueError, LookupError, struct.error) as error:
        raise damaged(named, 'cannot be read', error) from error
    if not salvaged.message_count:
        salvaged.close()
        return None
    return salvaged


def damaged(path: Path, problem: str, error: Exception) -> BagError:
    """Return the error for a file that cannot be read."""
    return BagError(
        f'{path}: {problem}: {described(error)}; if it was cut off or never closed, '
        f'`{REPAIR[suffix(path)]}` may save the readable part'
    )


def suffix(path: Path) -> str:
    """Return the kind of a file: .mcap, .db3 or .bag."""
    return '.bag' if is_ros1(path) else Path(unpacked_name(path)).suffix


def described(error: Exception) -> str:
    """Return the message of an error, with its type unless rosbags wrote it for users."""
    text = str(error).rstrip('.')
    return text if type(error).__name__ == 'ReaderError' else f'{type(error).__name__}: {text}'
