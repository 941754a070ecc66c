# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Atomic writing of files, and the order of numbered files.

The bytes go to a temporary file in the directory of the target (a rename works within one file
system only) and to the disk, before the file is renamed. Readers, also after a crash or on a full
disk, see the old file or the new one, never a part.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
import fcntl
import json
import math
import os
from pathlib import Path
import re
import secrets
import shutil
import tempfile
from typing import Any, BinaryIO

from surfel_mapper.errors import FileFormatError

PART = '.surfel_mapper-'
"""Start of the names of temporary files, which end with ``.part``."""


@contextmanager
def replace_file(path: str | Path) -> Iterator[BinaryIO]:
    """
    Open a binary file that replaces ``path`` at the end of the block, and is removed on an error.

    Parameters
    ----------
    path : str or Path
        The target; of a symbolic link, the file that it leads to. The directory must exist. The
        permissions of the new file follow the umask.

    Raises
    ------
    FileFormatError
        If the file cannot be written: no such directory, no permission, disk full, or the path is
        not a regular file. Other errors of the block are raised unchanged.

    """
    target = Path(os.path.realpath(path))
    if os.path.exists(target) and not os.path.isfile(target):
        raise FileFormatError(f'{path}: not a regular file, expected one, or a new name')
    temporary = target.with_name(f'{PART}{secrets.token_hex(8)}.part')
    try:
        file = open(temporary, 'x+b')  # noqa: SIM115 - closed before it is renamed
    except OSError as error:
        raise cannot_write(path, error) from error
    except BaseException:  # without memory for the object: the file has been made
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    try:
        with file:
            with suppress(OSError):  # a file system without locks
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(temporary, target)
        sync(target.parent)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(temporary)):
            raise cannot_write(path, error) from error
        raise


def remove_abandoned(directory: Path) -> list[Path]:
    """Remove the temporary files of processes that have died, which hold no lock; return them."""
    removed = []
    for path in directory.glob(f'{PART}*.part'):
        with suppress(OSError):  # locked, gone, or a link
            file = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()
                removed.append(path)
            finally:
                os.close(file)
    return removed


@contextmanager
def replace_directory(path: Path) -> Iterator[Path]:
    """
    Yield the path of a directory to make, which replaces ``path`` at the end of the block.

    It has the same name, in a hidden directory that is removed in any case. If it is not made, or
    an error leaves the block, ``path`` stays as it is. Errors are raised unchanged.
    """
    hidden = Path(tempfile.mkdtemp(prefix=f'.{path.name}.', dir=path.parent))
    fresh, replaced = hidden / path.name, hidden / f'{path.name}.replaced'
    try:
        yield fresh
        if not fresh.exists():
            return
        for made in (*fresh.rglob('*'), fresh):
            sync(made)
        try:
            if path.exists():
                path.rename(replaced)
            fresh.rename(path)
        except BaseException:  # an interrupt too: the hidden directory is removed in any case
            if replaced.exists() and not path.exists():
                replaced.rename(path)
            raise
        sync(path.parent)
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


def check_free(path: Path, overwrite: bool) -> None:
    """Raise FileFormatError if a path is in use, and may not be overwritten."""
    if not overwrite and (use := use_of(path)):
        raise FileFormatError(f'{path}: {use}')


def use_of(path: Path) -> str:
    """Return how a path is in use, and the ways out; empty for a new path or empty directory."""
    if not os.path.lexists(path) or (path.is_dir() and not any(path.iterdir())):
        return ''
    use = (
        'has files in it; expected a new or empty directory'
        if path.is_dir()
        else ('exists; expected a new name')
    )
    return f'{use}, or --overwrite (in Python: overwrite=True, for replay in its ReplayOptions)'


def make_directory(directory: Path) -> None:
    """
    Make a directory and its parents, unless they exist.

    Raises
    ------
    FileFormatError
        If a file is in its place or in that of a parent, or it cannot be made.

    """
    nearest_directory(directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(f'{directory}: cannot be made: {error.strerror or error}') from error


def nearest_directory(directory: Path) -> Path:
    """Return the directory or its nearest parent that exists; FileFormatError for a file there."""
    absolute = directory.absolute()
    nearest = next(path for path in (absolute, *absolute.parents) if os.path.lexists(path))
    if not nearest.is_dir():
        raise FileFormatError(f'{directory}: {nearest} is a file, expected a directory')
    return nearest


def sync(path: Path) -> None:
    """Wait until a file, or the names in a directory, are on the disk, if that is supported."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        with suppress(OSError):  # some network file systems refuse
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def check_names(path: str | Path, names: Iterable[str]) -> None:
    """Refuse names of columns that would change the meaning of a header of text."""
    for name in names:
        if not re.fullmatch('[!-~]+', name):
            raise FileFormatError(f'{path}: column {name!r}, expected ASCII without spaces')


def write_json(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write finite values as indented JSON, atomically; see replace_file and finite_or_none."""
    with replace_file(path) as file:
        file.write((json.dumps(content, indent=2, allow_nan=False) + '\n').encode())


def finite_or_none(content: Any) -> Any:
    """Return plain values with None for nan and infinite numbers, which JSON does not have."""
    if isinstance(content, dict):
        return {key: finite_or_none(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return type(content)(map(finite_or_none, content))
    return None if isinstance(content, float) and not math.isfinite(content) else content


def by_number(file: Path) -> list[Any]:
    """Return a sort key of a file name: scan2 comes before scan10."""
    return [int(token) if token.isdecimal() else token for token in re.split(r'(\d+)', file.name)]


def cannot_write(path: str | Path, error: OSError) -> FileFormatError:
    """Return the error that names the file as the user wrote it."""
    return FileFormatError(f'{path}: cannot be written: {error.strerror or error}')
