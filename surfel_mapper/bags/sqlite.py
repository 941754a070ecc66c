# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reading of sqlite3 bags, through SQLite.

A database may define views, virtual tables and computed columns, which SQLite evaluates when they
are read: one row of text can make endless rows of gigabytes. A bag has plain tables, so files with
anything else are refused before a row is read. Pages that several others lead to also make rows
without end, so SQLite is interrupted when the time of the file is over, and a table of more rows
than fit into the file is refused.

Messages are sorted by their row numbers, not with their bytes: without an index SQLite would sort
all bytes of the bag in a temporary file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
import re
import sqlite3
from typing import Any, TYPE_CHECKING, TypeVar

from surfel_mapper.bags._rosbags import ros2_connection
from surfel_mapper.bags.bag_file import BagFile
from surfel_mapper.errors import BagError

if TYPE_CHECKING:
    from surfel_mapper.bags._rosbags import Connection

T = TypeVar('T')

STEPS = 20_000
"""Instructions of SQLite after which the time is checked: about a millisecond."""

LEAST_ROW_BYTES = 9
"""Bytes of the smallest message in a table: two numbers, a header of five bytes and its place."""

READ_BYTES, ROW_BYTES = 1 << 16, 1 << 9
"""Size of messages read together, and of one beside its bytes; asking for the time takes 3 us."""

DEFINITION = 'topic_type', 'encoding', 'encoded_message_definition', 'type_description_hash'
"""Columns of the definition of a type."""

PLAIN = re.compile(r'\s*CREATE\s+(TABLE|(UNIQUE\s+)?INDEX)\b', re.IGNORECASE)
"""Beginning of the definition of a table or an index, not of a view, trigger or virtual table."""

ALL = 'SELECT topic_id, timestamp FROM messages NOT INDEXED'

INDEXED = 'SELECT sum(1) FROM messages INDEXED BY "{}"'
"""Counts row by row; count(*) is a single instruction, which cannot be interrupted."""

CHOSEN = """
SELECT found.timestamp, message.timestamp, message.topic_id, message.data
FROM (
    SELECT rowid AS number, timestamp FROM messages {} WHERE topic_id IN ({})
    AND timestamp BETWEEN ? AND ? ORDER BY timestamp, rowid LIMIT -1
) AS found CROSS JOIN messages AS message ON message.rowid = found.number
"""
"""Row numbers in the order of time, and the message of each; SQLite keeps the order of a subquery
that has a limit, and of the tables of a cross join."""


class SqliteFile(BagFile):
    """The messages of a complete sqlite3 bag."""

    MAGIC = b'SQLite format 3\0'

    def _survey(self) -> None:
        """Check the tables, keep the topics and count the messages."""
        uri = f'{self.path.absolute().as_uri()}?mode=ro&immutable=1'
        self._database = sqlite3.connect(uri, uri=True, check_same_thread=False)
        try:
            self._database.set_progress_handler(self._is_late, STEPS)
            self._check_tables()
            self._read_topics()
            self._count_messages()
            self._check_indexes()
        except BaseException:
            self._database.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._database.close()
        super().close()

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, record time and bytes of messages, in order of record time."""
        wanted = {connection.id: connection for connection in connections}
        query = CHOSEN.format(self._order_by, ','.join('?' * len(wanted)))
        span = (-(2**63) if start is None else start, 2**63 - 1 if stop is None else stop - 1)
        with closing(self._database.cursor()) as cursor:
            self._ask(lambda: cursor.execute(query, (*wanted, *span)))
            while rows := self._ask(lambda: some_rows(cursor)):
                for indexed_ns, record_ns, topic, data in rows:
                    if topic not in wanted or record_ns != indexed_ns or type(data) is not bytes:
                        raise ValueError(f'a message at {record_ns} ns, or its index, is damaged')
                    yield wanted[topic], record_ns, data

    def _ask(self, call: Callable[[], T]) -> T:
        """Return the result of a call of SQLite, timed."""
        with self._budget.clock():
            try:
                return call()
            except sqlite3.OperationalError:
                self._budget.check_time()
                raise

    def _is_late(self) -> bool:
        """Return whether SQLite is to be interrupted."""
        try:
            self._budget.check_time()
        except BagError:
            return True
        return False

    def _rows(self, query: str, *values: object) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query."""
        with closing(self._database.cursor()) as cursor:
            try:
                yield from cursor.execute(query, values)
            except sqlite3.OperationalError:
                self._budget.check_time()
                raise

    def _check_tables(self) -> None:
        """Raise BagError if there are other things than tables of stored columns and indexes."""
        for kind, name, sql in self._rows('SELECT type, name, sql FROM sqlite_master'):
            self._budget.take(len(str(sql)), 'definitions of tables')
            if kind not in ('table', 'index') or not (sql is None or PLAIN.match(str(sql))):
                raise BagError(
                    f'{self.path}: {kind} {name!r}, expected tables and indexes only; is this a '
                    'bag?'
                )
            if kind == 'table':
                hidden = 'SELECT count(*) FROM pragma_table_xinfo(?) WHERE hidden'
                if [*self._rows(hidden, name)] != [(0,)]:
                    raise BagError(
                        f'{self.path}: table {name!r} has computed columns; is this a bag?'
                    )

    def _read_topics(self) -> None:
        """Keep the topics; raise ValueError if one is not described by texts."""
        columns = {name for _, name, *_ in self._rows('PRAGMA table_info(topics)')}
        qos = 'offered_qos_profiles' if 'offered_qos_profiles' in columns else "''"
        query = f'SELECT id, name, type, serialization_format, {qos} FROM topics'
        definitions = self._definitions()
        for key, *texts in self._rows(query):
            if not isinstance(key, int) or not all(isinstance(text, str) for text in texts):
                raise ValueError(f'topic {key!r} is not described by texts')
            topic, type_, encoding, profiles = texts
            kind, definition, digest = definitions.get(type_, ('', '', ''))
            connection = ros2_connection(
                key,
                topic,
                type_,
                None,
                encoding=encoding,
                qos=profiles,
                definition=(kind, definition),
                digest=digest,
            )
            self._keep_connection(key, connection, 4 * sum(map(len, texts)))

    def _definitions(self) -> dict[str, tuple[str, str, str]]:
        """Return format, text and hash of the definition of each type; none before ROS 2 Iron."""
        found: dict[str, tuple[str, str, str]] = {}
        known = {name for _, name, *_ in self._rows('PRAGMA table_info(message_definitions)')}
        if not known.issuperset(DEFINITION):
            return found
        for row in self._rows(f'SELECT {", ".join(DEFINITION)} FROM message_definitions'):
            if all(isinstance(text, str) for text in row):
                self._budget.take(ROW_BYTES + 4 * sum(map(len, row)), 'definitions of types')
                type_, kind, text, digest = row
                found[type_] = kind, text, digest
        return found

    def _count_messages(self) -> None:
        """Count the messages of each topic; raise ValueError if one has no topic or time."""
        counts: Counter[int] = Counter()
        most, first_ns, last_ns = self.size // LEAST_ROW_BYTES, 2**63 - 1, -(2**63)
        for number, (topic, record_ns) in enumerate(self._rows(ALL)):
            if number > most:
                raise BagError(f'{self.path}: more messages than a file of {self.size} bytes has')
            if type(topic) is not int or type(record_ns) is not int:
                raise ValueError(f'message of topic {topic!r} at {record_ns!r}, expected integers')
            counts[topic] += 1
            first_ns, last_ns = min(first_ns, record_ns), max(last_ns, record_ns)
        unknown = sum(count for topic, count in counts.items() if topic not in self._by_id)
        if unknown:
            self.losses.append(f'{unknown} messages are skipped, as their topic is not described')
        self._counts = counts
        if counts:
            self._note_span(first_ns, last_ns)

    def _check_indexes(self) -> None:
        """Note a loss, and sort without an index, if one has another number of messages."""
        number, self._order_by = sum(self._counts.values()), ''
        for _, name, _, _, is_partial in self._rows('PRAGMA index_list(messages)'):
            if is_partial:
                continue
            ((indexed,),) = self._rows(INDEXED.format(str(name).replace('"', '""')))
            if (indexed or 0) != number:
                self._order_by = 'NOT INDEXED'
                self.losses.append(f'{number} messages, but {indexed or 0} in the index {name!r}')


def some_rows(cursor: sqlite3.Cursor) -> list[tuple[Any, ...]]:
    """Return the next rows, at least one unless there are none, of some size together."""
    rows, size = [], 0
    while size < READ_BYTES and (row := cursor.fetchone()) is not None:
        rows.append(row)
        size += ROW_BYTES + len(row[-1] or b'')
    return rows
