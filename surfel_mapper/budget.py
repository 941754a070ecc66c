# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Budget: the bytes that reading one message may take.

A reader of bytes from the network asks its budget before each allocation whose size the message
states. The limit is proportional to the size of the message, with a floor that small messages may
always use and an upper bound of three quarters of the memory of the machine. The environment
variable SURFEL_MAPPER_MAX_BYTES replaces it by one number for messages of any size.

``read_small_file`` reads files that people write, such as settings, ``open_regular`` opens others.
"""

from __future__ import annotations

from collections.abc import Callable
import errno
import os
from pathlib import Path
import re
import stat
from typing import BinaryIO

from surfel_mapper.errors import ConfigError
from surfel_mapper.memory import machine_bytes

FLOOR_BYTES = 64 << 20
"""Memory that reading any message may take: one image of 16 Mpixel."""

BYTES_PER_BYTE = 20
"""Memory per byte of a message above the floor; 16 bytes of a point become 40."""

VARIABLE = 'SURFEL_MAPPER_MAX_BYTES'
"""Environment variable with the limit of memory for one message, and for a verb that reads files,
bytes."""

MAX_TEXT_BYTES = 1 << 20
"""Size limit of files that people write: settings, chains of filters, metadata.yaml."""


NOT_REGULAR = 'not a regular file'


class Budget:
    """
    The bytes that reading one input may take.

    Parameters
    ----------
    name : str or Path
        Topic or file, named in errors.
    size : int
        Bytes of the input.
    error : callable of str to Exception
        Class of the errors of the reader.

    Attributes
    ----------
    max_bytes : int
        The limit.
    used_bytes : int
        Memory requested, bytes.

    """

    def __init__(self, name: str | Path, size: int, error: Callable[[str], Exception]) -> None:
        self.name = name
        usual = min(max(FLOOR_BYTES, BYTES_PER_BYTE * size), machine_bytes() * 3 // 4)
        self.max_bytes = stated_limit() or usual
        self.used_bytes = 0
        self._error = error

    def take(self, num_bytes: int, purpose: str) -> None:
        """
        Ask for memory before allocating it.

        Raises
        ------
        Exception
            The error of the reader, if the sum of the memory asked for exceeds the limit.

        """
        needed = self.used_bytes + num_bytes
        if needed > self.max_bytes:
            raise self._error(
                f'{self.name}: {purpose}: needs {needed} bytes, more than the limit of '
                f'{self.max_bytes} for an input of this size; is it damaged? Otherwise set '
                f'{VARIABLE}'
            )
        self.used_bytes = needed


def stated_limit() -> int:
    """
    Return the limit in SURFEL_MAPPER_MAX_BYTES, or 0 if it is not set.

    Raises
    ------
    ConfigError
        If it is not a positive integer, of at most 18 digits. Readers let it pass: their input is
        not damaged.

    """
    text = os.environ.get(VARIABLE, '')
    if text and not re.fullmatch('0*[1-9][0-9]{0,17}', text):
        raise ConfigError(
            f'{VARIABLE}: {text!r}, expected a positive number of bytes, such as 4294967296'
        )
    return int(text or 0)


def read_small_file(path: str | Path, max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """
    Return the content of a regular file of limited size.

    Opened without blocking: a pipe without a writer does not hang, and a device is never read.

    Raises
    ------
    OSError
        If the file cannot be opened or read.
    ValueError
        If it is not a regular file or larger than ``max_bytes``.

    """
    with open(path, 'rb', opener=open_without_blocking) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise ValueError(NOT_REGULAR)
        content = file.read(max_bytes + 1)
    if content is None:  # a log of the kernel, such as /proc/kmsg, at its end
        raise ValueError(NOT_REGULAR)
    if len(content) > max_bytes:
        raise ValueError(f'larger than {max_bytes} bytes')
    return content


def open_regular(path: str | Path) -> BinaryIO:
    """
    Return a file opened for reading, of which as many bytes can be read as its size states.

    Of devices and pipes it is not: /dev/zero has no end, and a pipe without a writer blocks.

    Raises
    ------
    OSError
        If the file cannot be opened, or is not a regular file.

    """
    file = open(path, 'rb', opener=open_without_blocking)  # noqa: SIM115 - for the caller
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, NOT_REGULAR)
    return file


def open_without_blocking(path: str, flags: int) -> int:
    """Open a file for ``open``; a named pipe is opened even without a writer."""
    return os.open(path, flags | getattr(os, 'O_NONBLOCK', 0))
