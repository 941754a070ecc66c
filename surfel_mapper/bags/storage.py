# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Opening one file of a bag, by its kind.

A database that SQLite cannot read, or that is truncated, is read page by page. Each exception that
damaged files lead to becomes a BagError here.
"""

from __future__ import annotations

from pathlib import Path
import struct

from surfel_mapper.bags._rosbags import import_rosbags
from surfel_mapper.bags.bag_file import BagFile
from surfel_mapper.bags.chunked import ChunkedFile
from surfel_mapper.bags.mcap import McapFile
from surfel_mapper.bags.paths import is_ros1, unpacked_name
from surfel_mapper.bags.ros1 import Ros1File
from surfel_mapper.bags.sqlite import SqliteFile
from surfel_mapper.bags.sqlite_pages import is_short, SalvagedSqlite
from surfel_mapper.budget import open_regular
from surfel_mapper.errors import BagError, SurfelMapperError

OURS: dict[str, type[BagFile]] = {'.mcap': McapFile, '.db3': SalvagedSqlite, '.bag': Ros1File}
"""The reader for each kind of file, if it may be damaged."""

REPAIR = {'.mcap': 'mcap recover', '.db3': 'sqlite3 FILE .recover', '.bag': 'rosbag reindex'}
"""The tool that may repair a damaged file."""


def open_storage(path: Path, named: Path | None = None) -> BagFile:
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
    import_rosbags()
    try:
        if suffix(path) == '.db3' and not is_short(path):
            return SqliteFile(path)
        return open_ours(path, named)
    except SurfelMapperError:
        raise
    except Exception as error:
        if suffix(path) != '.db3':
            raise damaged(named, 'cannot be read', error) from error
    try:
        return open_ours(path, named)
    except (ValueError, LookupError, struct.error) as error:
        raise damaged(named, 'cannot be read', error) from error


def open_ours(path: Path, named: Path) -> BagFile:
    """Return a file opened by our own reader; raise ValueError or BagError if it has nothing."""
    kind = OURS[suffix(path)]
    with open_regular(path) as file:
        if file.read(len(kind.MAGIC)) != kind.MAGIC:
            raise ValueError(f'its first bytes are not those of {suffix(path)}')
    storage = kind(path)
    if storage.message_count or (storage.cut_at is None and not storage.skipped_at):
        return storage
    storage.close()
    reason = storage.skip_reason if isinstance(storage, ChunkedFile) else ''
    reason = reason or f'no whole message before byte {storage.cut_at}'
    raise BagError(f'{named}: cannot be read: {reason}; {repair(path)}')


def repair(path: Path) -> str:
    """Return the advice for a damaged file."""
    return (
        f'if it was cut off or never closed, `{REPAIR[suffix(path)]}` may save the readable part'
    )


def damaged(path: Path, problem: str, error: Exception) -> BagError:
    """Return the error for a file that cannot be read."""
    return BagError(f'{path}: {problem}: {described(error)}; {repair(path)}')


def suffix(path: Path) -> str:
    """Return the kind of a file: .mcap, .db3 or .bag."""
    return '.bag' if is_ros1(path) else Path(unpacked_name(path)).suffix


def described(error: Exception) -> str:
    """Return the message of an error, with its type unless rosbags wrote it for users."""
    text = str(error).rstrip('.')
    return text if type(error).__name__ == 'ReaderError' else f'{type(error).__name__}: {text}'
