# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which files make up a bag, and what its metadata.yaml states about them.

A rosbag2 recording is a directory of one or more files and a metadata.yaml, which is written last
and so is missing where the recorder was killed. It alone states that messages or whole files are
compressed; the files of such a bag cannot be read one by one.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import re
from typing import Any

from surfel_mapper.errors import BagError

STORAGE_SUFFIXES = ('.mcap', '.db3')
METADATA = 'metadata.yaml'


def files_of(path: Path) -> list[Path]:
    """
    Return what is to be opened for a bag, in the order of recording.

    That is the file itself, the files of a directory, or the directory where its files or
    messages are compressed.

    Raises
    ------
    BagError
        If there is no bag at the path, or the file is a compressed part of a larger bag.

    """
    if path.is_dir():
        information = metadata(path)
        if information is None:
            return loose_files(path)
        return [path] if is_compressed(information) else listed_files(path, information)
    if not path.is_file():
        raise BagError(f'{path}: no such file or directory; expected a bag')
    information = metadata(path.parent)
    listed = [] if information is None else listed_files(path.parent, information)
    if information is not None and path in listed and is_compressed(information):
        if len(listed) == 1:
            return [path.parent]
        raise BagError(
            f'{path}: one of {len(listed)} compressed files of a bag; name {path.parent} instead'
        )
    if path.suffix not in (*STORAGE_SUFFIXES, '.bag'):
        raise BagError(
            f'{path}: not a bag; expected a rosbag2 directory, or a file ending in .mcap, .db3 '
            'or .bag'
        )
    return [path]


def stated_counts(path: Path) -> dict[str, int]:
    """Return how many messages of each topic the metadata.yaml of a directory states."""
    information = metadata(path) if path.is_dir() else None
    if information is None:
        return {}
    try:
        return {
            str(row['topic_metadata']['name']): int(row['message_count'])
            for row in information['topics_with_message_count']
        }
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(path / METADATA, error) from error


def metadata(directory: Path) -> Mapping[str, Any] | None:
    """Return the content of metadata.yaml in a directory, or nothing where there is none."""
    import yaml

    path = directory / METADATA
    if not path.is_file():
        return None
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
        information = content['rosbag2_bagfile_information']
        if not isinstance(information, Mapping):
            raise TypeError(f'rosbag2_bagfile_information is a {type(information).__name__}')
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError) as error:
        raise damaged(path, error) from error
    return information


def is_compressed(information: Mapping[str, Any]) -> bool:
    """Return whether files or messages are compressed, beyond what a file says of itself."""
    return str(information.get('compression_mode') or 'none').lower() != 'none'


def listed_files(directory: Path, information: Mapping[str, Any]) -> list[Path]:
    """
    Return the files that metadata.yaml lists.

    Their directory is this one whatever is written there: early versions put the name of the
    bag before them, and a bag may have been renamed since.
    """
    names = information.get('relative_file_paths')
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BagError(
            f'{directory / METADATA}: relative_file_paths is {names!r}, expected a list of names'
        )
    files = [directory / Path(name).name for name in names]
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise BagError(f'{directory}: {", ".join(missing)} of its {METADATA} is missing')
    return files


def loose_files(directory: Path) -> list[Path]:
    """Return the storage files in a directory without metadata.yaml, bag_2 before bag_10."""
    files = [file for file in directory.iterdir() if file.suffix in STORAGE_SUFFIXES]
    if not files:
        raise BagError(
            f'{directory}: not a bag: neither {METADATA} nor an .mcap or .db3 file in it'
        )

    def by_number(file: Path) -> list[Any]:
        return [int(part) if part.isdigit() else part for part in re.split(r'(\d+)', file.name)]

    return sorted(files, key=by_number)


def damaged(path: Path, error: Exception) -> BagError:
    """Return the error for a metadata.yaml that does not read."""
    return BagError(
        f'{path}: not the metadata of a bag: {type(error).__name__}: {error}; '
        'without this file the .mcap and .db3 files beside it are read as they are'
    )
