# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reading of mcap files without a usable index, record by record.

A killed recorder, a full disk or an interrupted copy leaves a file without its index. rosbags
refuses it. The StreamReader of the mcap package reads its whole records, so up to one chunk before
the cut is lost. Opening the file counts the messages and checks each chunk; a damaged chunk is
taken for the cut. Of a chunk only its offset and first record time are kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
import heapq
from pathlib import Path
from typing import Any, TYPE_CHECKING

from surfel_mapper.bags._rosbags import ros2_connection
from surfel_mapper.libraries import library

if TYPE_CHECKING:
    from mcap.records import Message

    from surfel_mapper.bags._rosbags import Connection

END_NS = 2**64
"""After every record time of mcap, a uint64."""


class StreamedMcap:
    """
    The messages of an mcap file, with the interface of rosbags' readers.

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    size : int
        Bytes of the file.
    cut_at : int, optional
        Offset of the first record that is not whole; None if the file is complete.
    connections : list of Connection
        With the number of messages found.
    start_time, end_time : int
        Record time of the first message, and one after that of the last.

    """

    def __init__(self, path: Path) -> None:
        library('mcap', 'reads mcap files that have no index', 'mcap')
        self.cut_at: int | None = None
        self.start_time, self.end_time = END_NS, 0
        self.path = path
        self.size = path.stat().st_size
        self._blocks: list[tuple[int, int]] = []  # first record time and offset
        self._schemas: dict[int, Any] = {}
        self._channels: dict[int, Any] = {}
        self._counts: Counter[int] = Counter()
        self._file = open(path, 'rb')  # noqa: SIM115 - closed by close()
        try:
            self._survey()
        except BaseException:
            self._file.close()
            raise
        self.connections = [self._connection(key) for key in sorted(self._channels)]
        self.message_count = self._counts.total()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, record time and bytes of messages, in order of record time."""
        wanted = {connection.id: connection for connection in connections}
        first_ns, end_ns = 0 if start is None else start, END_NS if stop is None else stop
        waiting: list[tuple[int, int, int, Message]] = []
        for block_ns, at in [*sorted(self._blocks), (END_NS, self.size)]:
            while waiting and waiting[0][0] < block_ns:
                record_ns, _, _, message = heapq.heappop(waiting)
                yield wanted[message.channel_id], record_ns, message.data
            for number, message in enumerate(self._messages_at(at)):
                if message.channel_id in wanted and first_ns <= message.log_time < end_ns:
                    heapq.heappush(waiting, (message.log_time, at, number, message))

    def losses(self, named: Path) -> list[str]:
        """Return a sentence for the cut, if the file is cut off."""
        if self.cut_at is None:
            return []
        return [
            f'{named}: the file is cut off or damaged at byte {self.cut_at} of {self.size}; '
            f'the {self.message_count} messages found are read'
        ]

    def _survey(self) -> None:
        """Note each whole record; raise ValueError if the file does not begin like mcap."""
        from mcap.exceptions import InvalidMagic

        at = 0
        try:
            for record in self._records(0):
                self._note(at, record)
                at = self._file.tell()
        except InvalidMagic as error:
            if at == 0:
                raise ValueError('its first bytes are not those of mcap') from error
            self.cut_at = at
        except Exception:  # of a record that is cut off or damaged, of many types
            self.cut_at = at

    def _note(self, at: int, record: Any) -> None:
        """Note schemas, channels and messages of a record; raise an error if it is damaged."""
        from mcap.records import Channel, Schema

        inner = opened(record)
        self._schemas.update((r.id, r) for r in inner if isinstance(r, Schema))
        self._channels.update((r.id, r) for r in inner if isinstance(r, Channel))
        messages = messages_among(inner)
        if messages:
            times = [message.log_time for message in messages]
            self._blocks.append((min(times), at))
            self._counts.update(message.channel_id for message in messages)
            self.start_time = min(self.start_time, min(times))
            self.end_time = max(self.end_time, max(times) + 1)

    def _messages_at(self, at: int) -> list[Message]:
        """Return the messages of the record at an offset; none at the end of the file."""
        if at == self.size:
            return []
        return messages_among(opened(next(self._records(at))))

    def _records(self, at: int) -> Iterator[Any]:
        """Yield the records from an offset on; the file then stands at the end of the last."""
        from mcap.stream_reader import StreamReader

        self._file.seek(at)
        reader = StreamReader(
            self._file, skip_magic=at > 0, emit_chunks=True, record_size_limit=self.size
        )
        yield from reader.records

    def _connection(self, key: int) -> Connection:
        """Return rosbags' description of a channel."""
        channel = self._channels[key]
        schema = self._schemas.get(channel.schema_id)
        name, definition = '', ('', '')
        if schema is not None:
            name, definition = schema.name, (schema.encoding, schema.data.decode(errors='replace'))
        if channel.message_encoding == 'ros1' and '/msg/' not in name:
            name = name.replace('/', '/msg/')
        return ros2_connection(
            key,
            channel.topic,
            name,
            self,
            encoding=channel.message_encoding,
            qos=channel.metadata.get('offered_qos_profiles', ''),
            definition=definition,
        )._replace(msgcount=self._counts[key])


def opened(record: Any) -> list[Any]:
    """Return the records in a chunk, or the record itself; raise an error if it is damaged."""
    from mcap.records import Chunk
    from mcap.stream_reader import breakup_chunk

    return breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]


def messages_among(records: list[Any]) -> list[Message]:
    """Return the messages among records."""
    from mcap.records import Message

    return [record for record in records if isinstance(record, Message)]
