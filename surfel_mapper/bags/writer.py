# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Writing rosbag2 directories, as mcap or sqlite3, through rosbags.

A bag appears under its name once it is complete. Until then it grows in a hidden directory beside
it, which is removed if anything fails; a bag to be overwritten stays until then too. rosbags
names the storage file after its directory, so the hidden directory contains one of the final name.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack, suppress
from pathlib import Path
import sqlite3
from typing import Any, TYPE_CHECKING

from surfel_mapper.bags._rosbags import jazzy_types, latched_profile, new_writer
from surfel_mapper.bags.paths import is_storage, METADATA
from surfel_mapper.bags.topics import CLOUD, ODOMETRY, TF
from surfel_mapper.errors import BagError
from surfel_mapper.files.atomic import replace_directory, use_of
from surfel_mapper.messages.cdr import MessageWriter, write_header
from surfel_mapper.messages.pointcloud2 import cloud_bytes, CloudBytes
from surfel_mapper.messages.poses import StampedPose

if TYPE_CHECKING:
    from surfel_mapper.bags._rosbags import Connection

STORAGES = ('mcap', 'sqlite3')

OF_A_BAG = (METADATA, 'world.json', 'simulation.json')
"""Files that a bag to be overwritten may have beside its storage; two are of a simulation."""

JOURNALS = ('-wal', '-shm', '-journal')
"""Endings of the files that SQLite keeps beside a .db3."""


class BagWriter:
    """
    Context manager that writes a bag: complete at the end of the block, or absent after an error.

    Parameters
    ----------
    path : str or Path
        Directory of the bag; missing parents are created.
    storage : str
        mcap or sqlite3.
    overwrite : bool
        Whether to replace a bag of that name. An empty directory is replaced in any case, one
        with other files never.

    Attributes
    ----------
    directory : Path
        Inside the block: the hidden directory. Files created there become part of the bag.

    Raises
    ------
    BagError
        If the storage is unknown, or the path exists and may not be overwritten; later, if the
        bag cannot be written.

    """

    def __init__(
        self, path: str | Path, storage: str = 'mcap', *, overwrite: bool = False
    ) -> None:
        self.path = Path(path).absolute()
        self.storage = storage
        self.overwrite = overwrite
        self.directory = self.path
        self._connections: dict[str, Connection] = {}
        if storage not in STORAGES:
            raise BagError(f'storage {storage!r}: expected {" or ".join(STORAGES)}')
        self._check_free()

    def __enter__(self) -> BagWriter:
        """Begin the bag in a hidden directory beside its path."""
        self._store = jazzy_types()
        with self._refusing(), ExitStack() as hidden:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.directory = hidden.enter_context(replace_directory(self.path))
            self._writer = new_writer(self.directory, self.storage)
            self._writer.open()
            self._hidden = hidden.pop_all()
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """Give the bag its name, or remove the incomplete bag after an error."""
        if kind is not None:
            with suppress(OSError, sqlite3.Error):  # a full disk; the first error says more
                self._writer.abort()
            self._hidden.__exit__(kind, error, trace)
            return
        with self._refusing(), self._hidden:
            self._writer.close()
            self._check_free()
        self.directory = self.path

    def write(
        self,
        topic: str,
        type_: str,
        record_ns: int,
        raw: bytes | memoryview,
        *,
        latched: bool = False,
        definition: tuple[str, str] | None = None,
    ) -> None:
        """
        Append a message; the first message of a topic adds the topic.

        Parameters
        ----------
        topic, type_ : str
            A type of ROS 2 Jazzy, such as sensor_msgs/msg/PointCloud2, or one with a definition.
        record_ns : int
            Record time; messages are expected in this order.
        raw : bytes
            The message as CDR.
        latched : bool
            Whether late subscribers get the last message: durability transient local.
        definition : (str, str), optional
            Text and hash of another type, see BagReader.definition.

        Raises
        ------
        BagError
            If the type is another one and has no definition, or the bag cannot be written.

        """
        if definition is None and type_ not in self._store.fielddefs:
            raise BagError(f'{self.path}: {topic}: {type_} without a definition, expected one')
        text, digest = definition or (None, None)
        with self._refusing():
            if topic not in self._connections:
                profiles = [latched_profile()] if latched else []
                self._connections[topic] = self._writer.add_connection(
                    topic,
                    type_,
                    typestore=self._store,
                    msgdef=text,
                    rihs01=digest,
                    offered_qos_profiles=profiles,
                )
            self._writer.write(self._connections[topic], record_ns, raw)

    def write_cloud(
        self,
        topic: str,
        record_ns: int,
        stamp_ns: int,
        frame_id: str,
        cloud: CloudBytes,
        *,
        latched: bool = False,
    ) -> None:
        """Append a sensor_msgs/PointCloud2."""
        raw = cloud_bytes(cloud, stamp_ns=stamp_ns, frame_id=frame_id)
        self.write(topic, CLOUD, record_ns, raw, latched=latched)

    def write_transform(
        self, topic: str, record_ns: int, pose: StampedPose, *, latched: bool = False
    ) -> None:
        """Append a tf2_msgs/TFMessage with one transform; latched for static ones."""
        message = MessageWriter()
        message.numbers('I', 1)
        write_pose(message, pose)
        self.write(topic, TF, record_ns, message.join(), latched=latched)

    def write_odometry(self, topic: str, record_ns: int, pose: StampedPose) -> None:
        """Append a nav_msgs/Odometry without covariances and velocity."""
        message = MessageWriter()
        write_pose(message, pose)
        message.numbers('d', *[0.0] * (36 + 6 + 36))
        self.write(topic, ODOMETRY, record_ns, message.join())

    def _check_free(self) -> None:
        """Raise BagError if the path exists and may not be replaced."""
        use = use_of(self.path)
        if not use:
            return
        if not self.overwrite:
            raise BagError(f'{self.path}: {use}')
        if self.path.is_symlink() or not self.path.is_dir():
            raise BagError(f'{self.path}: not a directory, so not a bag to overwrite')
        if not (self.path / METADATA).exists() and any(self.path.iterdir()):
            raise BagError(f'{self.path}: has files but no {METADATA}, so not a bag to overwrite')
        stray = next((file for file in sorted(self.path.iterdir()) if not is_of_bag(file)), None)
        if stray is not None:
            raise BagError(
                f'{self.path}: {stray.name} in it is no file of a bag, so not overwritten; move '
                'it, or name another directory'
            )

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        """Turn errors of the system into a BagError that names the bag."""
        try:
            yield
        except (OSError, sqlite3.Error) as error:
            reason = getattr(error, 'strerror', None) or error
            raise BagError(f'{self.path}: cannot be written: {reason}') from error


def write_pose(message: MessageWriter, pose: StampedPose) -> None:
    """Write header, child frame, position and quaternion."""
    write_header(message, pose.stamp_ns, pose.parent)
    message.string(pose.child)
    message.numbers('d', *pose.xyz, *pose.q_xyzw)


def is_of_bag(path: Path) -> bool:
    """Return whether a path in the directory of a bag is a file that belongs to a bag."""
    name = path.name
    for ending in JOURNALS:
        name = name.removesuffix(ending)
    return path.is_file() and (name in OF_A_BAG or is_storage(path.with_name(name)))
