# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a node that exist from configure to cleanup: mapper, thread, inputs, outputs."""

from __future__ import annotations

from collections import deque
from concurrent.futures import CancelledError
from contextlib import suppress
from functools import partial
import threading
import time

from surfel_mapper.compilation import CompileStage, run_stages
from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError, counted, SurfelMapperError
from surfel_mapper.files.atomic import remove_abandoned
from surfel_mapper.memory import lasting_objects
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.pipeline.checkpoints import Checkpoints, load_start
from surfel_mapper.pipeline.warm_up import node_stages
from surfel_mapper.poses import AUTO, SourceChoice
from surfel_mapper.ros.base_node import BaseNode
from surfel_mapper.ros.filter_files import fault_of
from surfel_mapper.ros.inputs import Inputs
from surfel_mapper.ros.main_thread import TaskQueue
from surfel_mapper.ros.map_files import directory_of, MapWriter, save_map
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.outputs import Outputs
from surfel_mapper.ros.pose_outputs import registration_outputs
from surfel_mapper.ros.services import Services

LATEST = 200
"""Scans whose latencies are kept for the percentiles: 10 s at 20 Hz."""

MOST_WAIT_NS = 60_000_000_000
"""Longest wait for the choice of a source of poses, ns; an older stamp is of another clock."""


class Session:
    """
    Mapper, mapping thread, inputs, outputs and services of a configured node.

    Parameters
    ----------
    node : BaseNode
        The node that owns the topics and services.
    config : Config
        All settings.
    tasks : TaskQueue
        Takes the error if the mapping thread fails.

    Attributes
    ----------
    checkpoints : Checkpoints
        Saves the map from time to time.
    latencies_s : deque of float
        Times from the stamps of the latest scans until ~/changed was published, by the clock of
        the node.

    Raises
    ------
    ConfigError
        If the settings ask for a feature that is not available.
    DependencyError
        If ``pose.source`` is tf and tf2_msgs is not installed; before anything is compiled.
    FileFormatError, MapError
        If the map of ``map.load`` cannot be read, or is not as configured.

    """

    def __init__(self, node: BaseNode, config: Config, tasks: TaskQueue) -> None:
        """Compile the kernels, then create publishers and services."""
        self._node = node
        self._tasks = tasks
        self.config = config
        self.mapper = Mapper(config)
        self.mapper.knows_source = config.pose.source != AUTO
        load_start(self.mapper)
        self.checkpoints = Checkpoints(self.mapper)
        for path in remove_abandoned(directory_of(config.output)):
            node.get_logger().info(f'{path} removed: its process died while it wrote a file')
        self.thread = MappingThread(self.mapper, tasks.fail)
        self._writer = MapWriter(self.mapper, self.thread)
        self.inputs = Inputs(node, config, self.thread, tasks.fail, self._on_choice)
        log, start = node.get_logger(), time.monotonic()
        log.info('loading kernels')
        with lasting_objects():
            run_stages(node_stages(self.mapper))
        self.outputs = Outputs(node, self.mapper, self.thread)
        self.registration = registration_outputs(node, self.mapper, self.thread)
        self.services = Services(node, self.mapper, self.thread, self.outputs, self._writer)
        log.info(f'kernels ready after {time.monotonic() - start:.1f} s')
        self.latencies_s: deque[float] = deque(maxlen=LATEST)
        self._changing = threading.Lock()  # transitions and settings come from two threads
        self._is_active, self._choice_ns = False, 0
        self.thread.start(self._on_update)

    def activate(self) -> None:
        """Subscribe and start publishing; raises the errors of ``Inputs.subscribe``."""
        try:
            self.inputs.subscribe()
        except SurfelMapperError:
            self.inputs.subscriptions.stop()
            raise
        with self._changing:
            self._is_active = True
            self._start_timers()

    def deactivate(self) -> None:
        """Unsubscribe, map the messages received so far, publish the map, and stop publishing."""
        self.inputs.subscriptions.stop()
        with self._changing:
            self._is_active = False
            self.outputs.stop_timers()
        with suppress(CancelledError):  # the thread has failed; its error is in the task queue
            self.thread.call(self.outputs.publish_latest).result()

    def reconfigure(self, config: Config) -> None:
        """Apply new settings from the next scan on."""
        with self._changing:
            self.config = config
            if self._is_active:
                self._start_timers()
        self.thread.post(self._reconfigure)

    def close(self, *, save: bool) -> None:
        """Map the messages received so far, end the thread, save the map if asked, and log."""
        self.thread.stop()
        self._writer.close()
        with self.mapper.guarded('the end of the outputs'):
            self.outputs.close()
        log = self._node.get_logger()
        with self.mapper.guarded('the end of the input'):
            self.mapper.finish()
        if self._tasks.has_failed and self.mapper.map.num_voxels:
            with self.mapper.guarded('a checkpoint'):
                log.error(f'the node stops on an error; map saved: {self.checkpoints.save()}')
        if save:
            try:
                log.info(f'saved {save_map(self.mapper)}')
            except Exception as error:  # MemoryError too
                log.error(f'the map could not be saved: {error or repr(error)}')
        log.info(report(self.mapper))

    def _start_timers(self) -> None:
        """Start publishing at rates; called with the lock held."""
        self.outputs.start_timers(self.config)

    def _on_update(self, update: Update) -> None:
        """Publish the changes of a scan; called in the mapping thread."""
        if not self.latencies_s:
            points = counted(len(update.filtered), 'point')
            self._node.get_logger().info(
                f'first scan {update.outcome.outcome}: {points} of frame {update.scan.frame_id}, '
                f'{counted(self.mapper.map.num_voxels, "voxel")}'
            )
        self.outputs.publish_update(update)
        with self.mapper.guarded('publishing of the pose'):
            if self.registration is not None:
                self.registration.publish(update)
        self._save_checkpoint()
        now_ns, ready_ns = self._node.get_clock().now().nanoseconds, update.stamp_ns
        if 0 < self._choice_ns - ready_ns < MOST_WAIT_NS:  # it has waited for a pose.source
            ready_ns = self._choice_ns
        self.latencies_s.append((now_ns - ready_ns) / 1e9)

    def _save_checkpoint(self) -> None:
        """Save a checkpoint if it is due, and another if scans came while it was written."""
        run = partial(self._writer.write, done=self._save_checkpoint)
        with self.mapper.guarded('a checkpoint'):
            self.checkpoints.save_if_due(run)

    def _on_choice(self, choice: SourceChoice) -> None:
        """Map the scans that have waited for the choice of ``pose.source: auto``."""
        self._choice_ns = self._node.get_clock().now().nanoseconds
        if choice.source == 'registration':
            self._tasks.submit(self._register_scans)  # compiles: signals end it there
        else:
            self.thread.post(partial(self._map_waiting, choice.source))

    def _register_scans(self) -> bool:
        """Take the poses from registration; called in the main thread, as scans wait on."""
        try:
            self.thread.call(self.mapper.register_scans).result()
            assert self.mapper.registered is not None
            run_stages([CompileStage('registration', self.mapper.registered.warm_up)])
            self.registration = registration_outputs(self._node, self.mapper, self.thread)
            self.thread.post(partial(self._map_waiting, 'registration'))
        except CancelledError:
            return False  # the session has ended
        except Exception as error:
            self._tasks.fail(error)
            return False
        return True

    def _map_waiting(self, source: str) -> None:
        """Map scans with poses of a source from now on; called in the mapping thread."""
        self.mapper.pose_source = source
        self.mapper.knows_source = True

    def _reconfigure(self) -> None:
        """Pass the newest settings to the mapper; called in the mapping thread."""
        try:
            self.mapper.reconfigure(self.config)
        except ConfigError:  # the filter file has changed since it was checked
            fault = fault_of(self.config.filters)
            text = f'settings not applied: filters: {self.config.filters}: {fault}'
            self._node.get_logger().error(text)
        self.outputs.expire()


def report(mapper: Mapper) -> str:
    """Return the counts and the digest of a map in one line."""
    summary = mapper.summary()
    scans = summary['scans']
    dropped = ', '.join(f'{cause} {number}' for cause, number in scans['dropped'].items())
    return (
        f'scans received {scans["received"]}, mapped {scans["mapped"]}, '
        f'gated {scans["gated"]}, dropped: {dropped or "none"}; surfels {summary["surfels"]}, '
        f'digest {summary["digest"]}'
    )
