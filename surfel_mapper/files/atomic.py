# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Files that are written whole or not at all, and the order of those that are numbered.

The bytes go to a temporary file in the directory of the file wanted (a rename works within one
file system only) and to the disk, before the name moves to them in one step. Whoever reads the
name, also after a crash or with the disk full, sees the old file or the new one, never a part.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import json
import os
from pathlib import Path
import re
import secrets
from typing import Any, BinaryIO

from surfel_mapper.errors import FileFormatError


@contextmanager
def replace_file(path: str | Path, *, lasting: bool = True) -> Iterator[BinaryIO]:
    """
    Give a binary file that becomes ``path`` at the end of the with-block, or vanishes on an error.

    Parameters
    ----------
    path : str or Path
        What is there is replaced; if it is a symbolic link, the file that it leads to. The
        directory must exist. The new file's permissions follow the umask.
    lasting : bool
        Whether to wait until the bytes are on the disk, which files of this run alone need not.

    Raises
    ------
    FileFormatError
        If the file cannot be written: no such directory, no permission, disk full, or something
        other than a file has the name. Any error of the with-block itself passes as it is.

    """
    target = Path(os.path.realpath(path))
    if os.path.exists(target) and not os.path.isfile(target):
        raise FileFormatError(f'{path}: not a regular file, expected one, or none yet')
    temporary = target.with_name(f'.surfel_mapper-{secrets.token_hex(8)}.part')
    try:
        file = open(temporary, 'x+b')  # noqa: SIM115 - closed before its name is moved
    except OSError as error:
        raise cannot_write(path, error) from error
    try:
        with file:
            yield file
            file.flush()
            if lasting:
                os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(temporary)):
            raise cannot_write(path, error) from error
        raise


def write_json(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write values as JSON, for people too, whole or not at all; see replace_file."""
    with replace_file(path) as file:
        file.write((json.dumps(content, indent=2) + '\n').encode())


def by_number(file: Path) -> list[Any]:
    """Return what files are sorted by so that scan2 comes before scan10."""
    return [int(part) if part.isdigit() else part for part in re.split(r'(\d+)', file.name)]


def cannot_write(path: str | Path, error: OSError) -> FileFormatError:
    """Return the error that names the file as the user wrote it."""
    return FileFormatError(f'{path}: cannot be written: {error.strerror or error}')
