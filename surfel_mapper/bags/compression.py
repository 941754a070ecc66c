# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Unpacking of messages and files that the recorder packed with zstd.

The module for zstd comes with rosbags.
"""

from __future__ import annotations

from pathlib import Path
import shutil
import sys
from typing import Any

from surfel_mapper.errors import BagError
from surfel_mapper.libraries import library

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
"""How a zstd frame begins; no CDR message does."""

PIECE_BYTES = 1 << 16
"""Size of the pieces in which a file is unpacked; at a cut the last one is lost."""


def unpack_file(path: Path, target: Path) -> bool:
    """
    Unpack a file that the recorder packed with zstd; return whether it was complete.

    Raises
    ------
    BagError
        If it is not zstd, or damaged before its end.

    """
    zstd = import_zstd()
    try:
        with zstd.open(path) as source, open(target, 'wb') as sink:
            shutil.copyfileobj(source, sink, PIECE_BYTES)
    except EOFError:
        return False
    except (OSError, zstd.ZstdError) as error:
        raise BagError(f'{path}: cannot be unpacked: {error}') from error
    return True


def import_zstd() -> Any:
    """Return the module for zstd: Python's own from 3.14 on, before that its backport."""
    name = 'compression.zstd' if sys.version_info >= (3, 14) else 'backports.zstd'
    return library(name, 'unpacks compressed bags', 'backports.zstd')
