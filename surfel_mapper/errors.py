# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Exceptions of this package.

    SurfelMapperError
      ConfigError          a setting is unknown, of the wrong type or out of bounds  (ValueError)
      CloudFormatError     a PointCloud2 that cannot be decoded                       (ValueError)
      PoseError            no pose for a scan, and waiting will not provide one
        PoseNotYetError    no transform around the stamp: one may still arrive
          PosesLateError   all transforms are older than the stamp: newer ones will arrive
      MapError             an operation that a surfel map cannot carry out
        MapLimitError      a voxel index or a count beyond the range of the integers  (ValueError)
        NotInMapError      removing moments that the map does not contain             (ValueError)
      FilterError          a filter cannot work on a scan                             (ValueError)
      ScanRefusedError     a scan that a stage of the pipeline leaves out, with the cause
      AlignmentError       scans, pairs or poses that do not determine poses          (ValueError)
      ModelError           points to which no models can be fitted                    (ValueError)
      BagError             a bag that cannot be read, or lacks a topic or poses
      FileFormatError      any other file that cannot be read or is damaged           (ValueError)
      SubscriberError      a topic to be published has no subscriber
      ClusterError         workers or a scheduler that cannot be reached, or die repeatedly
      DependencyError      an optional package is missing; says how to install it     (ImportError)

A caller that wants to continue with the next scan catches SurfelMapperError. ``refusing`` makes
any exception of a parser an error of its reader.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import logging
from pathlib import Path

MAX_LINE = 4000
"""Limit of a message, characters; a name in a damaged file may have megabytes."""


def one_line(text: object) -> str:
    """
    Return text as one line without terminal sequences: control characters are escaped.

    Of more than MAX_LINE characters the middle is left out.
    """
    string = str(text)
    if len(string) > MAX_LINE:
        half = MAX_LINE // 2 - 20
        string = f'{string[:half]} ... {len(string)} characters ... {string[-half:]}'
    return escaped(string)


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: 1 scan, 1,000 scans."""
    return f'{number:,} {noun}' if number == 1 else f'{number:,} {noun}s'


def escaped(text: str) -> str:
    """Return text of any length with control characters escaped."""
    if text.isprintable():
        return text
    return ''.join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


class LineFormatter(logging.Formatter):
    """Formats a log record as one line, a traceback below it as it is."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Return the message on one line: names of topics and files come from outside."""
        return one_line(super().formatMessage(record))


class SurfelMapperError(Exception):
    """Base of all errors of this package; the message is one line, see one_line."""

    def __str__(self) -> str:
        return one_line(super().__str__())


class ConfigError(SurfelMapperError, ValueError):
    """A setting is unknown, of the wrong type or out of bounds."""


class CloudFormatError(SurfelMapperError, ValueError):
    """A PointCloud2 whose fields, sizes or datatypes do not fit together."""


class PoseError(SurfelMapperError):
    """There is no pose at the requested stamp, and waiting will not provide one."""


class PoseNotYetError(PoseError):
    """There is no transform around the requested stamp: one may arrive."""


class PosesLateError(PoseNotYetError):
    """All transforms of a frame are older than the requested stamp: newer ones will arrive."""


class MapError(SurfelMapperError):
    """An operation that a surfel map cannot carry out; the map is unchanged."""


class MapLimitError(MapError, ValueError):
    """A voxel index or a number of points is beyond the range of the integers of the map."""


class NotInMapError(MapError, ValueError):
    """Moments to be removed are not, or not completely, in the map."""


class FilterError(SurfelMapperError, ValueError):
    """A filter cannot process a scan: a column is missing, or a value is unusable."""


class ScanRefusedError(SurfelMapperError):
    """
    A scan that a stage of the pipeline leaves out.

    Attributes
    ----------
    cause : str
        The cause by which the scan is counted.

    """

    def __init__(self, cause: str, reason: str = '') -> None:
        super().__init__(reason)
        self.cause = cause


class AlignmentError(SurfelMapperError, ValueError):
    """Scans, pairs or poses are not suitable for alignment; nothing is changed."""


class ModelError(SurfelMapperError, ValueError):
    """Points, or a viewpoint, to which no models can be fitted."""


class BagError(SurfelMapperError):
    """A bag cannot be read, or lacks the requested topic or poses."""


class FileFormatError(SurfelMapperError, ValueError):
    """A file other than a bag cannot be read: of another format or version, or damaged."""


class SubscriberError(SurfelMapperError):
    """A topic to be published has no subscriber."""


class ClusterError(SurfelMapperError):
    """Workers or their scheduler cannot be reached, or died repeatedly."""


class DependencyError(SurfelMapperError, ImportError):
    """A package that the requested feature needs is not installed; may have several lines."""

    def __str__(self) -> str:
        return '\n'.join(map(one_line, str(self.args[0]).split('\n')))


@contextmanager
def refusing(name: str | Path) -> Iterator[None]:
    """
    Turn every exception of a with-block that reads a file into a FileFormatError that names it.

    Each reader has one around all that it does, as libraries raise errors of many types for
    damaged content. Errors of this package and a lack of memory pass.
    """
    try:
        yield
    except (SurfelMapperError, MemoryError):
        raise
    except OSError as cause:
        raise FileFormatError(f'{name}: cannot be read: {cause.strerror or cause}') from cause
    except Exception as cause:
        problem = f'damaged, or of another format: {type(cause).__name__}: {cause}'
        raise FileFormatError(f'{name}: {problem}') from cause
