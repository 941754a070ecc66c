# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The files that make up a bag, and its metadata.yaml.

A rosbag2 recording is a directory of one or more files and a metadata.yaml, which is written last
and so is missing if the recorder was killed. Files compressed as a whole end in .zstd. Users
unpack and rename files, so the content of a file counts before its name.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
import logging
from pathlib import Path
import re
from textwrap import shorten
from typing import Any

from surfel_mapper.bags.compression import ZSTD_MAGIC
from surfel_mapper.config import read_yaml
from surfel_mapper.errors import BagError
from surfel_mapper.files.atomic import by_number

STORAGE_SUFFIXES = ('.mcap', '.db3')
PACKED_SUFFIXES = ('.zstd', '.zst')
BEGINNINGS = {'.mcap': b'\x89MCAP', '.db3': b'SQLite format 3', '.bag': b'#ROSBAG'}
"""First bytes of each kind of file."""

ROS1_SUFFIXES = ('.bag', '.bag.active')
METADATA = 'metadata.yaml'

_log = logging.getLogger(__name__)


def readable() -> str:
    """Return the formats of recordings, for errors; their modules load the compiler."""
    from surfel_mapper.files.scan_files import SUFFIXES

    return (
        f'a bag: a directory with {METADATA} or files ending in .mcap or .db3 (perhaps .zstd), or '
        f'a .bag of ROS 1; or scans: files ending in {", ".join(SUFFIXES)}, a folder of them, an '
        'Ouster .pcap, or depth images in the layout of TUM RGB-D, 7-Scenes, Replica or ScanNet'
    )


def files_of(path: Path) -> list[Path]:
    """
    Return the files of a bag, in the order of recording.

    That is the file itself, or the files of a directory.

    Raises
    ------
    BagError
        If there is no bag at the path.

    """
    if path.is_dir():
        information = metadata(path)
        return loose_files(path) if information is None else listed_files(path, information)
    if not path.is_file():
        raise BagError(f'{path}: no such file or directory; expected a bag or scans')
    if not is_storage(path) and not is_ros1(path):
        ending = path.suffix or 'a name without an ending'
        raise BagError(f'{path}: {ending} is not read; expected {readable()}')
    return [path]


def is_ros1(path: Path) -> bool:
    """Return whether a path is a ROS 1 bag, closed or not, by its name."""
    return path.name.lower().endswith(ROS1_SUFFIXES)


def is_storage(path: Path) -> bool:
    """Return whether a path is a file of a rosbag2, packed or not, by its name."""
    return unpacked_name(path).lower().endswith(STORAGE_SUFFIXES)


def is_packed(path: Path) -> bool:
    """Return whether a file is compressed as a whole: by its first bytes, then by its name."""
    with open(path, 'rb') as file:
        head = file.read(16)
    is_named = path.suffix in PACKED_SUFFIXES and not head.startswith((*BEGINNINGS.values(),))
    return is_named or head.startswith(ZSTD_MAGIC)


def unpacked_name(path: Path) -> str:
    """Return the name of a file without the suffix of packed files."""
    return path.stem if path.suffix in PACKED_SUFFIXES else path.name


def stated_counts(path: Path) -> dict[str, int]:
    """Return the number of messages of each topic by the metadata.yaml of a directory."""
    information = metadata(path) if path.is_dir() else None
    if information is None:
        return {}
    try:
        return {
            row['topic_metadata']['name']: int(row['message_count'])
            for row in information['topics_with_message_count']
        }
    except (KeyError, TypeError, ValueError) as error:
        raise damaged_metadata(path / METADATA, error) from error


def metadata(directory: Path) -> Mapping[str, Any] | None:
    """Return the content of metadata.yaml in a directory, or None if there is no such file."""
    path = directory / METADATA
    if not path.is_file():
        return None
    try:
        information = read_yaml(path, as_text=True)['rosbag2_bagfile_information']
        if not isinstance(information, Mapping):
            raise TypeError(f'rosbag2_bagfile_information is a {type(information).__name__}')
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise damaged_metadata(path, error) from error
    return information


def listed_files(directory: Path, information: Mapping[str, Any]) -> list[Path]:
    """
    Return the files that metadata.yaml lists.

    Only the file names are used, in this directory: early versions put the name of the bag before
    them, the bag may have been renamed since, and no entry may lead to another directory.
    """
    names = information.get('relative_file_paths')
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BagError(
            f'{directory / METADATA}: relative_file_paths is {names!r}, expected a list of names'
        )
    files = [directory / Path(name).name for name in names]
    foreign = [file.name for file in files if not is_storage(file)]
    if foreign:
        raise BagError(
            f'{directory / METADATA}: lists {", ".join(foreign)}, expected .mcap or .db3 files'
        )
    if not all(map(Path.is_file, files)):
        return replaced_files(directory, files)
    names = {unpacked_name(file) for file in files}
    if extra := [f.name for f in loose_files(directory) if unpacked_name(f) not in names]:
        unlisted = ', '.join(extra)
        _log.warning('%s: %s is not in its %s and not read', directory, unlisted, METADATA)
    return files


def replaced_files(directory: Path, files: list[Path]) -> list[Path]:
    """
    Return the files of a directory in place of listed ones that were unpacked, packed or renamed.

    Raises
    ------
    BagError
        If there are fewer or more of them.

    """
    present = loose_files(directory)
    missing = ', '.join(file.name for file in files if not file.is_file())
    names = ', '.join(file.name for file in present)
    if len(present) != len(files):
        raise BagError(
            f'{directory}: {missing} of its {METADATA} is missing; without {METADATA} the rest is '
            f'read: {names}'
        )
    _log.warning('%s: %s of its %s is missing; %s is read', directory, missing, METADATA, names)
    return present


def loose_files(directory: Path) -> list[Path]:
    """
    Return the storage files in a directory without metadata.yaml, bag_2 before bag_10.

    Of a file that is there packed and unpacked, the unpacked one: a recorder removes it once the
    packed one is complete.
    """
    files = [file for file in directory.iterdir() if is_storage(file) and file.is_file()]
    names = {file.name for file in files}
    files = [f for f in files if f.name == unpacked_name(f) or unpacked_name(f) not in names]
    if not files:
        endings = Counter(file.suffix for file in directory.iterdir() if file.is_file())
        listed = ', '.join(f'{n} {ending or "without ending"}' for ending, n in endings.items())
        listed = f'files in it: {listed or "none"}'
        if folders := sorted(file.name for file in directory.iterdir() if file.is_dir()):
            listed += f'; its folders: {shorten(", ".join(folders), 80)}'
        raise BagError(f'{directory}: {listed}; expected {readable()}')
    files = sorted(files, key=by_number)
    matches = [re.fullmatch(r'(.*_)(\d+)\.\w+', unpacked_name(file)) for file in files]
    stems = {match and match[1] for match in matches}
    numbers = [int(match[2]) for match in matches if match and len(stems) == 1]
    if len(numbers) == len(files) <= numbers[-1] - numbers[0]:
        _log.warning(
            '%s: %d files from %s to %s: is a part of the bag missing?',
            *(directory, len(files), files[0].name, files[-1].name),
        )
    return files


def damaged_metadata(path: Path, error: Exception) -> BagError:
    """Return the error for a metadata.yaml that cannot be read."""
    return BagError(
        f'{path}: not the metadata of a bag: {type(error).__name__}: {error}; '
        'without this file the .mcap and .db3 files beside it are read directly'
    )
