# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Opening one file of a bag, by its kind.

rosbags reads files with an index. An mcap file without one is read record by record. Each
exception that damaged files lead to becomes a BagError here.
"""

from __future__ import annotations

from pathlib import Path
import struct
from typing import TYPE_CHECKING

from surfel_mapper.bags._rosbags import import_rosbags, open_indexed
from surfel_mapper.bags.compression import ZSTD_MAGIC
from surfel_mapper.bags.paths import BEGINNINGS, is_ros1, unpacked_name
from surfel_mapper.bags.streamed_mcap import StreamedMcap
from surfel_mapper.errors import BagError

if TYPE_CHECKING:
    from surfel_mapper.bags._rosbags import IndexedBag

    Storage = IndexedBag | StreamedMcap

RECOVER = 'sqlite3 {0} .recover | sqlite3 mended.db3'

DUMP = 'sqlite3 {0} .dump | sed "s/^ROLLBACK.*/COMMIT;/" | sqlite3 mended.db3'

MEND = {
    '.mcap': '`mcap recover {0} -o mended.mcap` may save the readable part',
    '.db3': f'`{RECOVER}` may save the readable part, or `{DUMP}` if that sqlite3 cannot recover',
    '.bag': 'if it was never closed, `rosbag reindex {0}` of ROS 1 may mend it',
}
"""
Advice for a damaged file. The sqlite3 of Debian 12 cannot recover. A dump of a cut database loses
all rows if the upper pages of its tree are behind the cut.
"""


HEADER = struct.Struct('>H10xI')
"""Size and number of the pages of a database, at byte 16."""


def open_storage(path: Path, named: Path) -> Storage:
    """
    Open one file of a bag.

    Parameters
    ----------
    path : Path
        The file.
    named : Path
        Name in errors: of the packed file, if the file is an unpacked copy.

    Raises
    ------
    BagError
        If it cannot be read and holds no whole message either.

    """
    import_rosbags()
    try:
        if suffix(path) == '.db3' and is_short(path):
            raise ValueError('shorter than its header states')
        indexed = open_indexed(path)
        if indexed is not None:
            return indexed
    except Exception as error:  # rosbags raises many types for damaged files
        if suffix(path) != '.mcap':
            raise damaged(named, 'cannot be read', error) from error
    try:
        streamed = StreamedMcap(path)
    except (OSError, ValueError) as error:
        raise damaged(named, 'cannot be read', error) from error
    if streamed.message_count or streamed.cut_at is None:
        return streamed
    streamed.close()
    raise BagError(
        f'{named}: cannot be read: no whole message before byte {streamed.cut_at}; {advice(named)}'
    )


def is_short(path: Path) -> bool:
    """Return whether a database is cut off; SQLite fills a last page that is cut with zeros."""
    with open(path, 'rb') as file:
        header = file.read(100).ljust(100, b'\0')
    page_bytes, num_pages = HEADER.unpack_from(header, 16)
    size: int = (65536 if page_bytes == 1 else page_bytes) * num_pages
    return path.stat().st_size < size


def advice(path: Path) -> str:
    """Return the advice for a damaged file, or the first bytes of a file of another kind."""
    kind = suffix(path)
    with open(path, 'rb') as file:
        head = file.read(16)
    if head.startswith((BEGINNINGS[kind], ZSTD_MAGIC)):
        return MEND[kind].format(path)
    return f'it begins with {head!r}, expected {BEGINNINGS[kind]!r}; was it downloaded whole?'


def damaged(path: Path, problem: str, error: Exception) -> BagError:
    """Return the error for a file that cannot be read."""
    return BagError(f'{path}: {problem}: {described(error)}; {advice(path)}')


def suffix(path: Path) -> str:
    """Return the kind of a file: .mcap, .db3 or .bag."""
    return '.bag' if is_ros1(path) else Path(unpacked_name(path)).suffix.lower()


def described(error: Exception) -> str:
    """Return the message of an error, with its type unless rosbags wrote it for users."""
    text = str(error).rstrip('.')
    return text if type(error).__name__ == 'ReaderError' else f'{type(error).__name__}: {text}'
