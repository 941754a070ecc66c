# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Packed models as std_msgs/UInt8MultiArray, and ModelsMirror: a client's exact copy of the models.

The bytes of a message are those of a file. A message is complete, or holds the primitives that
changed since the previous message and the ids that are gone. Both are numbered, so a client
notices if one is lost.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError, counted, FileFormatError
from surfel_mapper.messages.cdr import MessageWriter
from surfel_mapper.models.multi_model import Gaussians, MultiModel, Plane, Surface
from surfel_mapper.models.packing import unpack

Ids = tuple[int, ...]

LABEL = 'surfel_mapper models'
"""Label of the only dimension of the array."""

COMPLETE_EVERY = 20
"""A complete message comes this often at least, for clients that lost one."""


class ModelStream:
    """
    Makes the messages of models that change.

    Attributes
    ----------
    number : int
        Messages so far.

    """

    def __init__(self) -> None:
        self.number = 0
        self._sent: MultiModel | None = None
        """The models that clients have."""

    def changes(
        self, model: MultiModel, versions: Mapping[int, int], **message: Any
    ) -> bytes | None:
        """
        Return the message of the changes since the last one; None if there are none.

        The first message and every COMPLETE_EVERY-th are complete.

        Parameters
        ----------
        model : MultiModel
            The present models.
        versions : mapping of int to int
            Their versions, by id.
        message : optional
            stamp_ns and frame_id.

        """
        sent = self._sent
        if sent is None or self.number % COMPLETE_EVERY == 0:
            return self.complete(model, versions, **message)
        changed = changed_ids(sent, model)
        removed = sorted(ids_of(sent) - ids_of(model))
        if not changed and not removed:
            return None
        self._sent = model
        update = selected(model, changed)
        return self._message(update, versions, tuple(removed), is_complete=False, **message)

    def complete(self, model: MultiModel, versions: Mapping[int, int], **message: Any) -> bytes:
        """Return the message of all models; see ``changes``."""
        self._sent = model
        return self._message(model, versions, (), **message)

    def _message(
        self, model: MultiModel, versions: Mapping[int, int], removed: Ids, **message: Any
    ) -> bytes:
        """Return a message, and count it."""
        data = model.to_bytes(versions, removed, number=self.number, **message)
        self.number += 1
        return byte_array(data)


def ids_of(model: MultiModel) -> set[int]:
    """Return the ids of all primitives."""
    return {*(patch.id for patch in model.patches), *model.gaussians.id.tolist()}


def changed_ids(old: MultiModel, new: MultiModel) -> set[int]:
    """
    Return the ids of new primitives and of others than previous.

    A patch that is fitted again is another object. Points of a Gaussian change without a new
    version if they are few.
    """
    patches = {patch.id: patch for patch in old.patches}
    changed = {patch.id for patch in new.patches if patches.get(patch.id) is not patch}
    previous, current = old.gaussians, new.gaussians
    _, rows, previous_rows = np.intersect1d(current.id, previous.id, return_indices=True)
    same = (current.num_points[rows] == previous.num_points[previous_rows]) & np.logical_and(
        (current.mean[rows] == previous.mean[previous_rows]).all(axis=1),
        (current.covariance[rows] == previous.covariance[previous_rows]).all(axis=(1, 2)),
    )
    return changed | set(np.delete(current.id, rows[same]).tolist())


def selected(model: MultiModel, ids: Collection[int]) -> MultiModel:
    """Return the primitives with some ids, without labels."""
    rows = np.isin(model.gaussians.id, np.fromiter(ids, np.int64, len(ids)))
    return replace(
        model,
        planes=[plane for plane in model.planes if plane.id in ids],
        surfaces=[surface for surface in model.surfaces if surface.id in ids],
        gaussians=rows_of(model.gaussians, rows),
        labels=np.empty(0, np.int32),
    )


def rows_of(gaussians: Gaussians, rows: npt.NDArray[Any]) -> Gaussians:
    """Return some Gaussians."""
    columns = (gaussians.id, gaussians.num_points, gaussians.mean, gaussians.covariance)
    return Gaussians(*(column[rows] for column in columns))


def byte_array(data: bytes) -> bytes:
    """Return the serialised std_msgs/UInt8MultiArray of bytes, of one dimension."""
    writer = MessageWriter()
    writer.numbers('I', 1)
    writer.string(LABEL)
    writer.numbers('I', len(data), len(data), 0, len(data))  # size, stride, offset; length
    writer.append(data, 1)
    return writer.join()


class ModelsMirror:
    """
    A copy of the models of a node that follows ``~/models``.

    Attributes
    ----------
    model : MultiModel or None
        The copy, without labels; None before the first complete message.
    versions : dict of int to int
        Versions of its primitives, by id.
    stamp_ns : int
        Stamp of the newest scan in it; 0 at first.
    is_complete : bool
        Whether the copy equals the models of the node: false until a complete message has come,
        and after a message was lost until the next complete one.

    Examples
    --------
    >>> mirror = ModelsMirror()
    >>> mirror.is_complete, mirror.model
    (False, None)

    """

    def __init__(self) -> None:
        self.model: MultiModel | None = None
        self.versions: dict[int, int] = {}
        self.stamp_ns = 0
        self.is_complete = False
        self._number = 0

    def __repr__(self) -> str:
        """Return the number of primitives, and whether the copy is complete."""
        state = '' if self.is_complete else 'not '
        return f'ModelsMirror({counted(len(self.versions), "primitive")}, {state}complete)'

    def update(self, msg: Any) -> None:
        """
        Follow a message on ``~/models``.

        Parameters
        ----------
        msg : std_msgs/UInt8MultiArray
            From rclpy or rosbags.

        Raises
        ------
        CloudFormatError
            If its bytes are no packed models; the copy is unchanged then.

        """
        try:
            unpacked = unpack(bytes(msg.data), LABEL)
        except FileFormatError as error:
            raise CloudFormatError(str(error)) from error
        header, model = unpacked.header, MultiModel.from_unpacked(unpacked)
        follows = self.is_complete and header.number == self._number + 1
        self._number = header.number
        self.is_complete = header.is_complete or follows
        if header.is_complete:
            self.model, self.versions = model, unpacked.versions
        elif self.is_complete and self.model is not None:
            gone = {*unpacked.removed, *unpacked.versions}
            self.model = joined(self.model, model, gone)
            self.versions = {n: v for n, v in self.versions.items() if n not in gone}
            self.versions |= unpacked.versions
        else:
            return
        self.stamp_ns = header.stamp_ns


def joined(old: MultiModel, new: MultiModel, gone: Collection[int]) -> MultiModel:
    """Return new primitives with those of the old ones that are not gone, by ascending id."""
    kept = selected(old, {p.id for p in old.patches if p.id not in gone})
    rows = ~np.isin(old.gaussians.id, np.fromiter(gone, np.int64, len(gone)))
    pairs = [
        (getattr(old.gaussians, name)[rows], getattr(new.gaussians, name))
        for name in ('id', 'num_points', 'mean', 'covariance')
    ]
    gaussians = Gaussians(*(np.concatenate(pair) for pair in pairs))
    planes: list[Plane] = sorted([*kept.planes, *new.planes], key=lambda plane: plane.id)
    surfaces: list[Surface] = sorted([*kept.surfaces, *new.surfaces], key=lambda s: s.id)
    order = np.argsort(gaussians.id)
    return replace(new, planes=planes, surfaces=surfaces, gaussians=rows_of(gaussians, order))
