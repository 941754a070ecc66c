# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The thread that owns the mapper, and its bounded queue.

Callbacks only append to the queue, so messages are taken from the middleware as they arrive: its
queues overwrite old messages silently, while drops from this queue are counted. Poses overtake
clouds. They are small, and a backlog of clouds would otherwise be mapped before the poses that it
needs, although these have arrived.

A kernel that is compiled only now, for a rare input, must cost no cloud: the queue is then bounded
by bytes, until it is as short again as its usual bound in clouds.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from functools import partial
from itertools import chain
import threading
from typing import Any, NamedTuple, TypeVar

from surfel_mapper.compilation import PROGRESS
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.memory import machine_bytes
from surfel_mapper.messages.cdr import frame_name
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.messages.poses import StampedPose
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.pipeline.drops import described, INTERNAL, REMEDIES
from surfel_mapper.pipeline.scan_images import MAX_IMAGES
from surfel_mapper.poses.buffer import MAX_EDGES
from surfel_mapper.ros.turns import take_turns
from surfel_mapper.scan import Scan
from surfel_mapper.sensors.depth import SceneImage

MAX_POSES = 10_000
"""
Most poses in the queue, 10 s of odometry at 1 kHz; then the oldest is dropped. Static ones are
kept apart, as they do not come again.
"""

SHARE_OF_MEMORY = 8
"""Clouds that come while kernels compile take at most this fraction of the machine's memory."""

TOO_FAST = f'clouds come faster than they can be mapped; {REMEDIES["overload"]}'

Result = TypeVar('Result')


class QueuedCloud(NamedTuple):
    """A cloud or image in the queue, and the function that decodes it to a scan."""

    msg: Any
    topic: str
    decode: Callable[[Any, str], Scan]

    @property
    def frame_id(self) -> str:
        """The frame by which a drop is counted; empty, so the topic instead, if it is invalid."""
        try:
            return frame_name(self.msg.header.frame_id)
        except CloudFormatError:
            return ''


class Lost(NamedTuple):
    """How a dropped cloud of a topic is counted, or else a dropped pose or image; see Mapper."""

    cause: str
    reason: str
    topic: str = ''
    frame_id: str = ''


TOO_MANY_POSES = Lost('overload', 'poses dropped: too many are waiting')


class Call(NamedTuple):
    """A function in the queue, and the future for its result, if one is wanted."""

    function: Callable[[], Any]
    future: Future[Any] | None = None


class MappingThread:
    """
    Feeds the mapper from a queue.

    Parameters
    ----------
    mapper : Mapper
        Accessed by this thread only, from ``start`` to ``stop``.
    on_failure : callable
        Called in this thread with the error that ends it; see take_turns.

    Attributes
    ----------
    paused : bool
        If true, clouds are dropped and counted; poses are still used.
    num_clouds : int
        Number of clouds in the queue.

    """

    def __init__(self, mapper: Mapper, on_failure: Callable[[BaseException], None]) -> None:
        self.paused = False
        self._mapper = mapper
        self._on_failure = on_failure
        self._changed = threading.Condition()
        self._max_clouds = mapper.config.input.max_waiting_clouds
        self._static: dict[str, StampedPose] = {}  # by child
        self._poses: deque[StampedPose] = deque()
        self._images: defaultdict[str, deque[SceneImage]] = defaultdict(deque)  # by kind
        self._work: deque[QueuedCloud | Call] = deque()
        self.num_clouds = 0
        self._num_bytes = 0
        self._max_bytes = machine_bytes() // SHARE_OF_MEMORY
        self._is_behind = False  # because of kernels that were compiled
        self._lost: Counter[Lost] = Counter()
        self._stopping = False
        self._thread = threading.Thread()

    def start(self, on_update: Callable[[Update], None]) -> None:
        """Start the thread; it calls ``on_update`` with the result of every scan."""
        self._thread = threading.Thread(
            target=self._run, args=(on_update,), name='mapping', daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Work off the queue and end the thread."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join()

    def put_poses(self, poses: Iterable[StampedPose], *, static: bool = False) -> None:
        """Queue poses for the mapper; of the static ones of a frame, the latest."""
        with self._changed:
            if static:
                self._static.update((pose.child, pose) for pose in poses)
            else:
                self._poses.extend(poses)
            while len(self._poses) > MAX_POSES:
                self._poses.popleft()
                self._lost[TOO_MANY_POSES] += 1
            while len(self._static) > MAX_EDGES:  # the buffer of the mapper holds no more
                self._static.popitem()
                self._lost[TOO_MANY_POSES] += 1
            self._changed.notify()

    def refuse_pose(self, reason: str) -> None:
        """Count a pose message that cannot be decoded."""
        self._lose(Lost('bad_pose', reason))

    def refuse_image(self, reason: str) -> None:
        """Count an image of colours or labels, or its calibration, that cannot be decoded."""
        self._lose(Lost('bad_image', f'image ignored: {reason}'))

    def refuse_cloud(self, topic: str, reason: str) -> None:
        """Count a cloud that cannot be decoded."""
        self._lose(Lost('bad_cloud', reason, topic))

    def report_failure(self, task: str, error: Exception) -> None:
        """Count an error that nothing expects, of a callback in another thread."""
        self._lose(Lost(INTERNAL, f'{task} failed: {described(error)}'))

    def put_image(self, image: SceneImage) -> None:
        """
        Queue an image of colours or labels; like poses, they overtake clouds.

        Beyond MAX_IMAGES of a kind the oldest of this kind is dropped: ScanImages keeps no more.
        """
        with self._changed:
            images = self._images[image.kind]
            images.append(image)
            if len(images) > MAX_IMAGES:
                images.popleft()
                reason = f'{image.kind} images dropped: too many are waiting'
                self._lost[Lost('overload', reason)] += 1
            self._changed.notify()

    def put_cloud(
        self, msg: Any, topic: str, decode: Callable[[Any, str], Scan] = to_scan
    ) -> None:
        """Queue a cloud or depth image; if the queue is full, drop the oldest."""
        with self._changed:
            self._work.append(QueuedCloud(msg, topic, decode))
            self._count_cloud(msg, 1)
            self._is_behind |= PROGRESS.is_active
            while self._is_full():
                oldest = next(item for item in self._work if isinstance(item, QueuedCloud))
                self._work.remove(oldest)
                self._count_cloud(oldest.msg, -1)
                reason = f'in frame {oldest.frame_id!r}, {TOO_FAST}'
                self._lost[Lost('overload', reason, oldest.topic, oldest.frame_id)] += 1
            self._changed.notify()

    def _is_full(self) -> bool:
        """Return whether the oldest cloud has to go; called with the lock held."""
        self._is_behind &= self.num_clouds > self._max_clouds or PROGRESS.is_active
        if self._is_behind:
            return self._num_bytes > self._max_bytes and self.num_clouds > 1
        return self.num_clouds > self._max_clouds

    def _count_cloud(self, msg: Any, number: int) -> None:
        """Count a cloud that enters (1) or leaves (-1) the queue; called with the lock held."""
        self.num_clouds += number
        self._num_bytes += number * len(msg.data)

    def call(self, function: Callable[[], Result]) -> Future[Result]:
        """
        Call a function in this thread, after all clouds queued before it; return a future.

        The future is cancelled if the thread ends first.
        """
        future: Future[Result] = Future()
        with self._changed:
            if self._stopping:
                future.cancel()
            else:
                self._work.append(Call(function, future))
                self._changed.notify()
        return future

    def post(self, function: Callable[[], object]) -> None:
        """Call a function in this thread, unless it is queued already."""
        call = Call(function)
        with self._changed:
            if call not in self._work:
                self._work.append(call)
                self._changed.notify()

    def _run(self, on_update: Callable[[Update], None]) -> None:
        """Work until stopped, or until an error ends the thread."""
        try:
            take_turns(partial(self._step, on_update), partial(self.report_failure, 'mapping'))
        except BaseException as error:
            self._on_failure(error)
        with self._changed:
            self._stopping = True
            remaining, self._work = self._work, deque()
        for item in remaining:
            if isinstance(item, Call) and item.future:
                item.future.cancel()

    def _step(self, on_update: Callable[[Update], None]) -> bool:
        """Wait for input and process it; return False at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopping or self._has_input())
            if not self._has_input():
                return False
            static, self._static = self._static, {}
            poses, self._poses = self._poses, deque()
            images, self._images = self._images, defaultdict(deque)
            item = self._work.popleft() if self._work else None
            if isinstance(item, QueuedCloud):
                self._count_cloud(item.msg, -1)
            lost, self._lost = self._lost, Counter()
        with self._mapper.guarded('counting of drops'):
            self._count(lost)
        for pose in static.values():
            with self._mapper.guarded('a pose'):
                self._mapper.add_pose(*pose, static=True)
        for pose in poses:
            with self._mapper.guarded('a pose'):
                self._mapper.add_pose(*pose)
        for image in chain.from_iterable(images.values()):
            with self._mapper.guarded('an image'):
                self._mapper.add_image(image)
        if isinstance(item, QueuedCloud):
            with self._mapper.guarded('a cloud'):
                self._add(item)
        elif item is not None:
            with self._mapper.guarded('a task between two scans'):
                run_call(item)
        with self._mapper.guarded('mapping'):
            for update in self._mapper.insert_ready():
                with self._mapper.guarded('publishing'):
                    on_update(update)
        return True

    def _has_input(self) -> bool:
        """Return whether any input waits; called with the lock held."""
        return any((self._static, self._poses, self._images, self._work, self._lost))

    def _lose(self, lost: Lost) -> None:
        with self._changed:
            self._lost[lost] += 1
            self._changed.notify()

    def _count(self, lost: Counter[Lost]) -> None:
        """Report dropped messages to the mapper, which counts and logs them."""
        for message, number in lost.items():
            if not message.topic:
                self._mapper.ignore_message(message.cause, message.reason, number)
            else:
                self._mapper.refuse_clouds(
                    message.cause, message.topic, message.reason, number, message.frame_id
                )

    def _add(self, cloud: QueuedCloud) -> None:
        """Decode a cloud and pass it to the mapper; invalid ones are counted."""
        frame_id = cloud.frame_id
        if self.paused:
            reason = 'mapping is paused; call ~/pause with false to continue'
            self._mapper.refuse_clouds('paused', cloud.topic, reason, frame_id=frame_id)
            return
        try:
            with self._mapper.counters.timed('decode'):
                scan = cloud.decode(cloud.msg, cloud.topic)
        except CloudFormatError as error:
            reason = f'in frame {frame_id!r}, {error}'
            self._mapper.refuse_clouds('bad_cloud', cloud.topic, reason, frame_id=frame_id)
            return
        except Exception as error:  # MemoryError too
            self._mapper.refuse_clouds(
                INTERNAL, cloud.topic, f'not decoded: {described(error)}', frame_id=frame_id
            )
            return
        with self._mapper.guarded('a scan'):
            self._mapper.add_scan(scan, cloud.topic)


def run_call(call: Call) -> None:
    """Call a function; its result or error goes to the future, if there is one."""
    if call.future is None:
        call.function()
        return
    try:
        call.future.set_result(call.function())
    except Exception as error:
        call.future.set_exception(error)
