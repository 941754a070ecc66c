# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Named arrays and attributes in one checked file: the format of saved maps.

The file is an npz archive, so numpy reads the arrays without this package. Its member
``manifest.json`` has name and version of the format, attributes, type and shape of every array,
and the SHA-256 of all of that and of the arrays' bytes. Nothing is pickled.

Sizes in a file are not trusted: the headers of all arrays are compared with the manifest before an
array is unpacked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
import hashlib
import io
import json
import math
import os
from pathlib import Path
import re
import struct
from typing import Any, BinaryIO, IO
import zipfile

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError, refusing
from surfel_mapper.files.atomic import replace_file

FORMAT = 'surfel_mapper state'
VERSION = 1
MANIFEST = 'manifest.json'
CHUNK_BYTES = 1 << 20

MAX_MANIFEST_BYTES = 16 << 20
"""Limit of the manifest; 10,000 scans need 6 MB."""

NPY_HEADER_BYTES = 12000
"""Upper bound of the header that numpy writes before an array."""

NPY_MAGIC = b'\x93NUMPY\x01\x00'

NPY_HEADER = re.compile(
    re.escape(NPY_MAGIC) + rb"(..)\{'descr': '([<>|][biuf][0-9]{1,2})', 'fortran_order': False, "
    rb"'shape': \(((?:[0-9]{1,18}, ?)*(?:[0-9]{1,18})?)\), \} *\n",
    re.DOTALL,
)
"""Header of an array: its size, and the type and shape of the array."""

LOCAL_HEADER, LOCAL_MAGIC = struct.Struct('<4s22x2H'), b'PK\3\4'
"""Header of a member of a zip archive: its mark, the lengths of its name and of further fields."""

ENCRYPTED = 1
"""Bit of a zip member's flags."""

npy: Any = np.lib.format
"""Typed in recent versions of numpy only."""

Arrays = Mapping[str, npt.NDArray[Any]]


def save_state(
    path: str | Path,
    arrays: Arrays,
    attributes: Mapping[str, Any],
    *,
    compress: bool = False,
    lasting: bool = True,
) -> None:
    """
    Write arrays and attributes to a file, atomically.

    Parameters
    ----------
    path : str or Path
        The file; see replace_file. Equal content gives equal bytes.
    arrays : mapping of str to array
        Names of letters, digits, ``_``, ``-`` and ``.``; arrays of booleans, integers or floats.
    attributes : mapping of str
        JSON values; tuples come back as lists.
    compress : bool
        Compress with zlib: a map gets 1.7 times smaller and takes 4 times as long.
    lasting : bool
        Whether to wait until the bytes are on the disk; False for temporary files.

    Raises
    ------
    ValueError, TypeError
        If a name, an array or an attribute cannot be stored.
    FileFormatError
        If the file cannot be written.

    """
    contiguous = {name: np.asarray(array, order='C') for name, array in arrays.items()}
    for name, array in contiguous.items():
        if not is_array_name(name) or not is_array_type(array.dtype.str):
            raise ValueError(
                f'array {name!r} of dtype {array.dtype}, expected a name of letters, digits, _ - '
                'and ., and booleans, integers or floats'
            )
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
    with replace_file(path, lasting=lasting) as file:
        write_archive(
            file, manifest, contiguous, zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
        )


def write_archive(
    file: BinaryIO, manifest: Mapping[str, Any], arrays: Arrays, compress_type: int
) -> None:
    """Write manifest and arrays as a zip archive."""
    with zipfile.ZipFile(file, 'w') as archive:
        text = json.dumps(manifest, indent=1, allow_nan=False)
        archive.writestr(zipfile.ZipInfo(MANIFEST), text, compress_type, compresslevel=1)
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f'{name}.npy')  # without a date, so that bytes are equal
            if compress_type == zipfile.ZIP_STORED:
                info.file_size = array.nbytes + NPY_HEADER_BYTES  # decides on zip64
                with archive.open(info, 'w') as member:
                    write_npy(member, array)
                continue
            content = io.BytesIO()
            write_npy(content, array)
            archive.writestr(info, content.getbuffer(), compress_type, compresslevel=1)


def write_npy(file: IO[bytes], array: npt.NDArray[Any]) -> None:
    """Write a contiguous array as an npy file, piece by piece: it may be larger than memory."""
    npy.write_array_header_1_0(file, npy.header_data_from_array_1_0(array))
    content = array.reshape(-1).view(np.uint8)
    for first in range(0, len(content), CHUNK_BYTES):
        file.write(content[first : first + CHUNK_BYTES].data)


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
    with refusing(path, FileFormatError), open_regular(path) as file:
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
    members = {info.filename: info for info in archive.infolist()}
    if len(members) < len(archive.infolist()):
        raise FileFormatError(f'{path}: damaged: a member occurs twice')
    if MANIFEST not in members:
        raise FileFormatError(f'{path}: no {MANIFEST} inside, expected a state of surfel_mapper')
    manifest_size = members[MANIFEST].file_size
    if manifest_size > MAX_MANIFEST_BYTES:
        raise FileFormatError(
            f'{path}: {MANIFEST} of {manifest_size} bytes, expected at most {MAX_MANIFEST_BYTES}'
        )
    for info in members.values():
        check_packing(info)
    manifest = json.loads(read_bytes(archive, members.pop(MANIFEST)))
    if manifest['format'] != FORMAT or manifest['version'] != VERSION:
        raise FileFormatError(
            f'{path}: format {manifest["format"]!r}, version {manifest["version"]!r}, '
            f'expected {FORMAT!r}, version {VERSION}'
        )
    infos = [members.pop(f'{entry["name"]}.npy') for entry in manifest['arrays']]
    for info, entry in zip(infos, manifest['arrays'], strict=True):
        check_header(archive, info, entry)
    arrays: dict[str, npt.NDArray[Any]] = {}

    def read_arrays() -> Iterator[npt.NDArray[Any]]:
        """Yield the arrays; not read by a thread, which may die without a word if memory ends."""
        for entry, info in zip(manifest['arrays'], infos, strict=True):
            arrays[entry['name']] = read_array(archive, info)
            yield arrays[entry['name']]

    sha256 = content_sha256(manifest, read_arrays())
    if sha256 != manifest['sha256'] or members:
        raise FileFormatError(
            f'{path}: damaged: content has sha256 {sha256} and {len(members)} unknown members, '
            f'expected {manifest["sha256"]} and none'
        )
    return arrays, dict(manifest['attributes'])


def check_packing(info: zipfile.ZipInfo) -> None:
    """Raise ValueError if a member is encrypted or compressed with another method than zlib."""
    plain = info.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    if not plain or info.flag_bits & ENCRYPTED:
        raise ValueError(f'{info.filename}: encrypted, or packing {info.compress_type}')


def check_header(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, entry: Mapping[str, Any]
) -> None:
    """Raise ValueError if type, shape or size of an array differ from its entry."""
    with archive.open(info) as member:
        shape, dtype, start = array_header(member.read(NPY_HEADER_BYTES), info.filename)
    if dtype.str != entry['dtype'] or list(shape) != entry['shape']:
        raise ValueError(f'{info.filename}: {dtype.str} {shape}, expected {entry}')
    if not is_array_type(dtype.str):
        raise ValueError(f'{info.filename}: {dtype.str}, expected numbers or booleans')
    if math.prod(shape) * dtype.itemsize != info.file_size - start:
        raise ValueError(f'{info.filename}: {info.file_size} bytes for an array {shape}')


def array_header(content: bytes, name: str) -> tuple[tuple[int, ...], np.dtype[Any], int]:
    """
    Return shape and type of an array, and the offset of its numbers.

    numpy evaluates the header as a Python literal; here it has to be as ``save_state`` writes it.
    """
    match = NPY_HEADER.match(content)
    if match is None:
        raise ValueError(f'{name}: not an array of numbers of format 1.0, in C order')
    size, dtype, shape = match.groups()
    start = len(NPY_MAGIC) + 2 + int.from_bytes(size, 'little')
    if match.end() != start:
        raise ValueError(f'{name}: a header of {match.end()} bytes, expected {start}')
    numbers = tuple(int(number) for number in shape.decode().replace(' ', '').split(',') if number)
    return numbers, np.dtype(dtype.decode()), start


def read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> npt.NDArray[Any]:
    """Return one array whose header has been checked."""
    is_stored = info.compress_type == zipfile.ZIP_STORED
    content = (read_stored if is_stored else read_bytes)(archive, info)
    shape, dtype, start = array_header(bytes(content[:NPY_HEADER_BYTES]), info.filename)
    array: npt.NDArray[Any] = np.frombuffer(content, dtype, offset=start).reshape(shape)
    return array


def read_stored(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> memoryview:
    """
    Return a member that is not compressed, read at its place in the file, by any thread.

    zipfile copies it twice and adds it up for a second check, beside the hash of the content.
    """
    assert archive.fp is not None, 'the archive is open'
    file = archive.fp.fileno()
    header = os.pread(file, LOCAL_HEADER.size, info.header_offset)
    if len(header) < LOCAL_HEADER.size:
        raise EOFError(f'{info.filename}: its header is missing')
    magic, name_bytes, extra_bytes = LOCAL_HEADER.unpack(header)
    if magic != LOCAL_MAGIC:
        raise ValueError(f'{info.filename}: no header of a member where the directory states it')
    offset = info.header_offset + len(header) + name_bytes + extra_bytes
    content = np.empty(info.file_size, np.uint8).data
    filled = 0
    while num_read := os.preadv(file, [content[filled:]], offset + filled):
        filled += num_read
    if filled < len(content):
        raise EOFError(f'{info.filename}: {len(content) - filled} bytes missing')
    return content


def read_bytes(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytearray:
    """
    Return an unpacked member of exactly the size that it claims.

    Read in pieces: a single read unpacks up to 2 GiB before zipfile cuts to the claimed size.
    """
    content = bytearray(info.file_size)
    unfilled = memoryview(content)
    with archive.open(info) as stream:
        while chunk := stream.read(CHUNK_BYTES):
            unfilled[: len(chunk)] = chunk
            unfilled = unfilled[len(chunk) :]
    if len(unfilled):
        raise EOFError(f'{info.filename}: {len(unfilled)} bytes missing')
    return content


def is_array_name(name: str) -> bool:
    """Return whether a name is valid for an array, and so for a member of the archive."""
    return re.fullmatch(r'[A-Za-z0-9_.-]+', name) is not None


def is_array_type(dtype: str) -> bool:
    """Return whether arrays of this type are stored: booleans, integers and floats."""
    return re.fullmatch(r'[<>|][biuf][1-9][0-9]*', dtype) is not None
