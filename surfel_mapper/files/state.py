# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Named arrays and attributes in one checked file: the format of saved maps.

The file is an npz archive, so numpy reads the arrays without this package. Its member
``manifest.json`` has name and version of the format, attributes, type and shape of every array,
and the SHA-256 of all of that and of the arrays' bytes. Nothing is pickled.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import hashlib
import json
from pathlib import Path
from typing import Any, BinaryIO
import zipfile

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError, refusing
from surfel_mapper.files.atomic import replace_file

FORMAT = 'surfel_mapper state'
VERSION = 1
MANIFEST = 'manifest.json'
ZIP64_BYTES = 1 << 30
"""Arrays from this size on are written with sizes of 64 bits."""

npy: Any = np.lib.format
"""Typed in recent versions of numpy only."""

Arrays = Mapping[str, npt.NDArray[Any]]


def save_state(
    path: str | Path,
    arrays: Arrays,
    attributes: Mapping[str, Any],
    *,
    compress: bool = False,
) -> None:
    """
    Write arrays and attributes to a file, atomically.

    Parameters
    ----------
    path : str or Path
        The file; see replace_file. Equal content gives equal bytes.
    arrays : mapping of str to array
        Names of letters, digits, ``_``, ``-`` and ``.``; arrays of booleans, integers or floats,
        which is not checked.
    attributes : mapping of str
        JSON values; tuples come back as lists.
    compress : bool
        Compress with zlib: a map gets 1.7 times smaller and takes 4 times as long.

    Raises
    ------
    ValueError, TypeError
        If an attribute cannot be stored.
    FileFormatError
        If the file cannot be written.

    """
    contiguous = {name: np.asarray(array, order='C') for name, array in arrays.items()}
    manifest: dict[str, Any] = {
        'format': FORMAT,
        'version': VERSION,
        'attributes': dict(attributes),
        'arrays': [
            {'name': name, 'dtype': array.dtype.str, 'shape': array.shape}
            for name, array in contiguous.items()
        ],
    }
    manifest['sha256'] = content_sha256(manifest, contiguous.values())
    with replace_file(path) as file:
        write_archive(
            file, manifest, contiguous, zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
        )


def write_archive(
    file: BinaryIO, manifest: Mapping[str, Any], arrays: Arrays, compress_type: int
) -> None:
    """Write manifest and arrays as a zip archive, without dates, so that equal maps are equal."""
    with zipfile.ZipFile(file, 'w', compress_type, compresslevel=1) as archive:
        text = json.dumps(manifest, indent=1, allow_nan=False)
        archive.writestr(zipfile.ZipInfo(MANIFEST), text, compress_type, compresslevel=1)
        for name, array in arrays.items():
            is_large = array.nbytes >= ZIP64_BYTES
            with archive.open(f'{name}.npy', 'w', force_zip64=is_large) as member:
                npy.write_array(member, array, (1, 0), allow_pickle=False)


def content_sha256(manifest: Mapping[str, Any], arrays: Iterable[npt.NDArray[Any]]) -> str:
    """Return the hash of a manifest, without its own hash, and of its arrays in order."""
    covered = {key: value for key, value in manifest.items() if key != 'sha256'}
    content = hashlib.sha256(json.dumps(covered, sort_keys=True, allow_nan=False).encode())
    for array in arrays:
        content.update(array.reshape(-1).view(np.uint8).data)
    return content.hexdigest()


def load_state(path: str | Path) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """
    Return the arrays and the attributes of a file that save_state wrote.

    Parameters
    ----------
    path : str or Path
        The file.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is of another format or version, or is damaged.

    """
    with refusing(path), open_regular(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                return read_archive(path, archive)
        except zipfile.BadZipFile as error:
            raise FileFormatError(
                f'{path}: {error}; expected a state of surfel_mapper: damaged, or another file'
            ) from error


def read_archive(
    path: str | Path, archive: zipfile.ZipFile
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Return arrays and attributes; raise any exception if the content is inconsistent."""
    members = {*archive.namelist()}
    if MANIFEST not in members:
        raise FileFormatError(f'{path}: no {MANIFEST} inside, expected a state of surfel_mapper')
    manifest = json.loads(archive.read(MANIFEST))
    if manifest['format'] != FORMAT or manifest['version'] != VERSION:
        raise FileFormatError(
            f'{path}: format {manifest["format"]!r}, version {manifest["version"]!r}, '
            f'expected {FORMAT!r}, version {VERSION}'
        )
    arrays = {entry['name']: read_array(archive, entry) for entry in manifest['arrays']}
    unknown = members - {MANIFEST, *(f'{name}.npy' for name in arrays)}
    sha256 = content_sha256(manifest, arrays.values())
    if sha256 != manifest['sha256'] or unknown:
        raise FileFormatError(
            f'{path}: damaged: content has sha256 {sha256} and {len(unknown)} unknown members, '
            f'expected {manifest["sha256"]} and none'
        )
    return arrays, dict(manifest['attributes'])


def read_array(archive: zipfile.ZipFile, entry: Mapping[str, Any]) -> npt.NDArray[Any]:
    """Return the array of an entry; raise ValueError if its type or shape differs from it."""
    with archive.open(f'{entry["name"]}.npy') as member:
        array: npt.NDArray[Any] = npy.read_array(member, allow_pickle=False)
    if array.dtype.str != entry['dtype'] or list(array.shape) != entry['shape']:
        raise ValueError(f'{array.dtype.str} {array.shape}, expected {entry}')
    return array
