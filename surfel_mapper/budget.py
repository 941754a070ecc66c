# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Budget: the bytes and seconds that reading one input may take.

A reader of foreign bytes asks its budget before each allocation and each loop whose size the input
states. The limit is proportional to the size of the input, with a floor that small inputs may
always use and an upper bound of three quarters of the memory of the machine. The environment
variable SURFEL_MAPPER_MAX_BYTES replaces it by one number for inputs of any size. Time is
processor time of the thread, so that a busy machine refuses nothing.

``read_small_file`` reads files that people write, such as settings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import errno
from functools import cache
import os
from pathlib import Path
import re
import stat
import time
from typing import BinaryIO

from surfel_mapper.errors import ConfigError

FLOOR_BYTES = 64 << 20
"""Memory that reading any input may take: one unpacked chunk, one image of 16 Mpixel."""

BYTES_PER_BYTE = 20
"""Memory per byte of input above the floor; 16 bytes of a point become 40, 60 of a voxel 200."""

FLOOR_S = 5.0
"""Processor time that reading any input may take, s."""

SECONDS_PER_BYTE = 1e-6
"""Processor time per byte of input above the floor; the slowest reader (text) takes 200 ns."""

VARIABLE = 'SURFEL_MAPPER_MAX_BYTES'
"""Environment variable with the limit of memory for one input of any size, bytes."""

MAX_TEXT_BYTES = 1 << 20
"""Size limit of files that people write: settings, chains of filters, metadata.yaml."""


NOT_REGULAR = 'not a regular file'


class Budget:
    """
    The bytes and seconds that reading one input may take.

    Parameters
    ----------
    name : str or Path
        File or topic, named in errors.
    size : int
        Bytes of the input.
    error : callable of str to Exception
        Class of the errors of the reader.
    ratio : int
        Memory per byte of input.
    floor : int
        Memory that is always allowed, bytes.

    Attributes
    ----------
    max_bytes, max_seconds : int, float
        The limits.
    used_bytes : int
        Memory requested and not yet returned, bytes.
    used_s : float
        Processor time spent in ``clock``, s.

    """

    def __init__(
        self,
        name: str | Path,
        size: int,
        error: Callable[[str], Exception],
        *,
        ratio: int = BYTES_PER_BYTE,
        floor: int = FLOOR_BYTES,
    ) -> None:
        self.name = name
        self.max_bytes = limit_for(size, ratio, floor)
        self.max_seconds = max(FLOOR_S, SECONDS_PER_BYTE * size)
        self.used_bytes = 0
        self.used_s = 0.0
        self._error = error
        self._start_s: float | None = None

    @classmethod
    def of_file(cls, path: str | Path, error: Callable[[str], Exception]) -> Budget:
        """Return the budget of a file by its size, which is 0 for pipes and missing files."""
        try:
            size = os.stat(path).st_size
        except OSError:
            size = 0
        return cls(path, size, error)

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

    def give_back(self, num_bytes: int) -> None:
        """Return memory that was freed."""
        self.used_bytes -= num_bytes

    @contextmanager
    def clock(self) -> Iterator[None]:
        """Count the processor time of a with-block; callers that consume the results pay not."""
        if self._start_s is not None:
            yield  # in an outer block
            return
        self._start_s = time.thread_time()
        try:
            yield
        finally:
            self.used_s += time.thread_time() - self._start_s
            self._start_s = None

    def check_time(self) -> None:
        """Raise the error of the reader if reading has taken too much processor time."""
        running_s = 0.0 if self._start_s is None else time.thread_time() - self._start_s
        if self.used_s + running_s > self.max_seconds:
            raise self._error(
                f'{self.name}: reading took over {self.max_seconds:.1f} s of processor time, the '
                'limit for an input of this size; is it damaged?'
            )


def limit_for(size: int, ratio: int = BYTES_PER_BYTE, floor: int = FLOOR_BYTES) -> int:
    """Return the limit of memory for an input of a size, bytes."""
    return stated_limit() or min(max(floor, ratio * size), upper_bound())


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


@cache
def upper_bound() -> int:
    """Return three quarters of the memory of the machine, bytes; 3 GiB if that is unknown."""
    try:
        return os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') * 3 // 4
    except (ValueError, OSError, AttributeError):
        return 3 << 30


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
