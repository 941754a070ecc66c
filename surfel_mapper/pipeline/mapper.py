# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Mapper: the pipeline from scans and poses to a windowed map of surfels.

Node and replay drive this one class and only carry messages in and results out, so what they
map is the same to the bit. Time is the stamps of the data alone, never the clock: a scan waits
for its pose until newer data is more than ``pose.max_wait_s`` ahead of it, which a bag replayed
at any speed does alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_whole, check_kind
from surfel_mapper.compilation import CompileStage, run_stages
from surfel_mapper.config import Config, declarations
from surfel_mapper.errors import ConfigError, counted, MapError
from surfel_mapper.filters.chain import Chain
from surfel_mapper.geometry import compose, inverse, pose_matrix, Transform
from surfel_mapper.layers import names as layer_names
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.mapping.window import checked_scans, WindowedScan
from surfel_mapper.messages.poses import StampedPose
from surfel_mapper.pipeline.drops import ScanOutcome
from surfel_mapper.pipeline.loop_closer import LoopCloser, LoopMove
from surfel_mapper.pipeline.regions import Region
from surfel_mapper.pipeline.registered_poses import RegisteredPoses
from surfel_mapper.pipeline.scan_pipeline import ScanPipeline
from surfel_mapper.pipeline.update import Update
from surfel_mapper.pipeline.window_aligner import Alignment
from surfel_mapper.poses import AUTO
from surfel_mapper.scan import Scan
from surfel_mapper.sensors.depth import SceneImage


class Mapper:
    """
    Maps scans at their poses.

    Parameters
    ----------
    config : Config, optional
        All settings; the defaults without it. Poses come by ``add_pose``, so that ``pose.source``
        auto, tf, odometry and pose are the same here.

    Attributes
    ----------
    map : SurfelMap
        The map; changed by this class alone.
    window : SlidingWindow
        The scans that the map holds.
    layers : mapping of str to Layer
        The layers that are switched on, by name. The public object of each is also an attribute of
        the mapper (``mapper.tsdf``, ``mapper.models``), None if the layer is switched off.
    transforms : TransformBuffer
        The tree of frames.
    counters : Counters
        Scans used and dropped, and times by stage.

    Raises
    ------
    ConfigError
        If ``filters`` names a file that holds no chain, or the configuration is no Config.

    Examples
    --------
    >>> import numpy as np
    >>> from surfel_mapper import Config, Scan
    >>> mapper = Mapper(Config.from_mapping({'pose': {'source': 'identity'}}))
    >>> floor = np.random.default_rng(0).uniform([0, 0, 0.2], [2, 2, 0.2], (1000, 3))
    >>> mapper.add_scan(Scan(points=floor, stamp_ns=10**9, frame_id='odom'))
    >>> [update.stamp_ns for update in mapper.insert_ready()]
    [1000000000]
    >>> len(mapper.surfels())
    16

    """

    def __init__(self, config: Config | None = None) -> None:
        if config is not None and not isinstance(config, Config):
            raise ConfigError(
                f'a {type(config).__name__}, expected a Config: Config.from_mapping(settings), or '
                'load_config(path)'
            )
        self._pipeline = ScanPipeline(config or Config())
        self.counters = self._pipeline.counters
        self.map = self._pipeline.map
        self.window = self._pipeline.window
        self.layers = self._pipeline.layers.by_name
        self.transforms = self._pipeline.poses.transforms

    def __repr__(self) -> str:
        """Return the map and the number of scans of the window."""
        return f'Mapper({self.map!r}, {counted(len(self.window), "scan")} in the window)'

    @property
    def config(self) -> Config:
        """The settings now; see ``reconfigure``."""
        return self._pipeline.config

    if not TYPE_CHECKING:  # hidden from mypy: the names depend on the registry

        def __getattr__(self, name: str) -> Any:
            """Return the result of a layer, None if it is switched off: ``mapper.tsdf``."""
            if name in layer_names():
                return self.layers[name].public if name in self.layers else None
            raise AttributeError(f'{type(self).__name__!r} object has no attribute {name!r}')

    @property
    def registered(self) -> RegisteredPoses | None:
        """The poses found by registration; None if poses come from another source."""
        return self._pipeline.poses.registered

    @property
    def knows_source(self) -> bool:
        """
        Whether the source of the poses is known, True at first.

        A node sets it to False while ``pose.source: auto`` looks for one: scans wait, at most
        ``pose.max_waiting_scans``, and are mapped by ``insert_ready`` once it is True.
        """
        return self._pipeline.queue.is_open

    @knows_source.setter
    def knows_source(self, value: bool) -> None:
        self._pipeline.queue.is_open = value

    @property
    def outcomes(self) -> list[ScanOutcome] | None:
        """
        Outcomes of all scans received, in the order of the decisions.

        None unless a list is set, which grows without end: a replay sets one, the node does not.
        """
        return self._pipeline.drops.outcomes

    @outcomes.setter
    def outcomes(self, value: list[ScanOutcome] | None) -> None:
        self._pipeline.drops.outcomes = value

    @property
    def pose_source(self) -> str:
        """The source of the poses, for ``outcomes``; ``pose.source`` until another is set."""
        return self._pipeline.drops.pose_source

    @pose_source.setter
    def pose_source(self, value: str) -> None:
        self._pipeline.drops.pose_source = value

    def register_scans(self) -> None:
        """
        Take the poses from registration, as ``pose.source: auto`` does without another source.

        Raises
        ------
        ConfigError
            If ``pose.source`` is not auto, scans are mapped already, or ``map.origin`` is set,
            which needs poses in the fixed frame. Nothing has changed then.

        """
        source, origin = self.config.pose.source, self.config.map.origin
        num_used = self.counters.mapped + self.counters.localised
        if source != AUTO or num_used or origin:
            raise ConfigError(
                f'pose.source {source}, {counted(num_used, "scan")} mapped, map.origin {origin!r}'
                ': expected auto, none and none to take registration'
            )
        self._pipeline.register()

    @property
    def chain(self) -> Chain:
        """The filters that scans pass."""
        return self._pipeline.preparation.chain

    def add_pose(
        self,
        parent: str,
        child: str,
        stamp_ns: int,
        xyz: Any,
        q_xyzw: Any = None,
        *,
        static: bool = False,
    ) -> None:
        """
        Add the pose of one frame in another; a bad one is counted and warned about.

        Parameters
        ----------
        parent, child : str
            Names of the frames; the pose takes points of the child to the parent.
        stamp_ns : int
            Its time; ignored for a static pose.
        xyz : (3,) float, m
            Position of the child in the parent.
        q_xyzw : (4,) float
            Its orientation, a unit quaternion.
        static : bool
            The pose holds for all time.

        Raises
        ------
        ValueError
            If the stamp is no whole number.
        TypeError
            If a frame is no name, or there is no orientation, as with a matrix for the pose.

        """
        for name, frame in (('parent', parent), ('child', child)):
            if not isinstance(frame, str):
                raise TypeError(f'{name}: a {type(frame).__name__}, expected the name of a frame')
        if q_xyzw is None:
            shown = f'{np.shape(xyz)} for the position' if xyz is not None else 'no position'
            raise TypeError(
                f'add_pose: {shown} and no orientation, expected xyz (3,) and q_xyzw (4,); '
                'Trajectory.from_matrices turns matrices (S, 4, 4) into these'
            )
        if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, (int, np.integer)):
            raise ValueError(
                f'stamp_ns: {stamp_ns!r}, expected whole nanoseconds as an int, such as '
                'round(seconds * 1e9)'
            )
        check_kind('static', static, bool)
        for name, numbers in (('xyz', xyz), ('q_xyzw', q_xyzw)):
            check_kind(name, numbers, Iterable)
        self._pipeline.add_pose(StampedPose(parent, child, stamp_ns, xyz, q_xyzw), static=static)

    def add_scan(self, scan: Scan, topic: str = '') -> None:
        """
        Queue a scan until its pose is there; ``insert_ready`` maps it.

        A scan without points or frame, or with the stamp of an earlier one of its topic and frame,
        is dropped and counted. So is one older than the last, if its pose comes from registration.
        A stamp that goes back by more than ``input.reset_after_s`` clears the map, if other
        messages agree (see StampGuard); else the scan is dropped. ``input.time_offset_s`` is added
        to the stamp. The topic is for the log too. Raises TypeError for anything but a Scan.
        """
        if not (isinstance(scan, Scan) and isinstance(topic, str)):
            check_kind('scan', scan, Scan, hint='Scan(points=..., stamp_ns=..., frame_id=...)')
            check_kind('topic', topic, str)
        self.counters.received += 1
        if topic and topic != scan.topic:
            scan = scan.of_topic(topic)
        self._pipeline.add_scan(scan)

    def refuse_clouds(
        self, cause: str, topic: str, reason: str, number: int = 1, frame_id: str = ''
    ) -> None:
        """
        Count clouds that were received but not decoded: damaged, too many, or while paused.

        Parameters
        ----------
        cause : str
            Cause of the drops.
        topic : str
            Their topic.
        reason : str
            Value found, value expected and remedy, for the log.
        number : int
            Number of clouds.
        frame_id : str
            Their frame, by which they are counted; by default the topic.

        """
        self.counters.received += number
        self._pipeline.drops.clouds(cause, topic, reason, number, frame_id)

    def guarded(self, task: str) -> AbstractContextManager[None]:
        """
        Return a context that counts and logs an unexpected error of its block, and goes on.

        A node wraps its work on messages, requests and timers in it. ``messages_ignored`` counts
        such errors, MemoryError too, as ``internal_error``.
        """
        return self._pipeline.drops.guarded(task)

    def ignore_message(self, cause: str, reason: str, number: int = 1) -> None:
        """Count messages other than clouds that are not used, and warn."""
        self._pipeline.drops.message(cause, reason, number)

    def add_image(self, image: SceneImage) -> None:
        """Add an image that gives scans colours or labels; see layers.tsdf.color_topic."""
        check_kind('image', image, SceneImage)
        if self._pipeline.images is not None:
            self._pipeline.images.add(image)

    def end_images(self) -> None:
        """Stop waiting for images: no more come."""
        if self._pipeline.images is not None:
            self._pipeline.images.ended = True

    def end_scans(self) -> None:
        """Stop waiting for further scans and for poses: no more come."""
        self._pipeline.queue.ended = True
        if self.registered is not None:
            self.registered.scans_ended = True

    def insert_ready(self) -> Iterator[Update]:
        """
        Map the waiting scans whose poses are there, in order; yield an Update for each.

        A scan whose pose cannot come any more, or did not come in time, is dropped and counted.
        """
        return self._pipeline.run()

    def start_from(self, frame_id: str, xyz: Any, q_xyzw: Any) -> bool:
        """
        Continue registration from a given pose of the robot; warn if that is not possible.

        Parameters
        ----------
        frame_id : str
            Frame of the pose; must be that of the map.
        xyz : (3,) float, m
            Position of the base, or of the sensor if its mount on the base is unknown.
        q_xyzw : (4,) float
            Its orientation.

        Returns
        -------
        bool
            False if the pose was ignored.

        """
        if self.registered is None:
            reason = f'poses come from pose.source {self.config.pose.source}'
        elif frame_id != self.map_frame:
            reason = f'it is in frame {frame_id!r}, expected {self.map_frame!r}'
        else:
            try:
                T_map_body = pose_matrix(xyz, q_xyzw)
            except ValueError as error:
                reason = str(error)
            else:
                correction = self._pipeline.aligner.T_map_fixed
                self.registered.restart(compose(inverse(correction), T_map_body))
                return True
        self._pipeline.drops.message('initial_pose', f'initial pose ignored: {reason}')
        return False

    def finish_layers(self) -> None:
        """Finish the layers at the end of a recording; see Layer.finish."""
        self._pipeline.layers.finish()

    def finish(self) -> None:
        """End the input: scans that still wait for a certain pose are dropped and counted."""
        self._pipeline.finish()

    def clear(self) -> None:
        """Drop all scans, waiting ones too (counted); poses, counts and a frozen map stay."""
        self._pipeline.clear()

    @property
    def mount_changes(self) -> str:
        """Sensors that have moved on the robot since the oldest scan of the map, in words."""
        oldest = next(iter(self.window), None) if self.window.keeps_scans else None
        return self._pipeline.poses.mounts.warning(0 if oldest is None else oldest.stamp_ns)

    def align(self) -> Alignment:
        """
        Move the scans of the window to poses at which they agree; see the settings ``align``.

        The map then equals, to the bit, one that was built at the corrected poses. Scans to come
        are corrected like the newest one.

        Raises
        ------
        AlignmentError
            If points are not kept (``window.keep_points``), there are fewer than two scans, or
            no poses follow. Nothing has changed then.
        MapError
            If the map refuses a scan at its new pose. Nothing has changed then.

        """
        return self._pipeline.align()

    def close_loops(self, progress: Callable[[str], object] = lambda text: None) -> LoopMove:
        """
        Find places that were seen twice, and move all scans so that they agree there.

        The map then equals, to the bit, one that was built at the corrected poses; layers stay
        as they are. Scans to come are corrected like the newest one; the poses in
        ``frames.fixed`` do not change.

        Parameters
        ----------
        progress : callable
            Called with a line of text at each stage.

        Raises
        ------
        AlignmentError
            If points are not kept (``loops.enabled``), the window has evicted scans, or there
            are fewer than two. Nothing has changed then.
        MapError
            If the map refuses a scan at its new pose. Nothing has changed then.

        """
        return self._pipeline.close_loops(progress)

    @property
    def derives(self) -> bool:
        """Whether ``Update.changed`` is filled; False leaves it empty and saves the time."""
        return self._pipeline.derives

    @derives.setter
    def derives(self, value: bool) -> None:
        self._pipeline.derives = value

    @property
    def loops(self) -> LoopCloser | None:
        """The scans and poses that loops are closed with; None without ``loops.enabled``."""
        return self._pipeline.loops

    @property
    def T_map_fixed(self) -> Transform:
        """From the fixed frame of the poses to the map: its origin, and alignment's correction."""
        return compose(self._pipeline.aligner.T_map_fixed, self._pipeline.origin.T_local_fixed)

    @property
    def origin_m(self) -> npt.NDArray[np.float64] | None:
        """
        Place of the map's origin in the fixed frame by ``map.origin``, (3,) m.

        None without that setting, and with ``auto`` until the first pose is known.
        """
        origin = self._pipeline.origin
        return self.map.origin_m if origin.has_own_frame and origin.is_known else None

    def T_map_of(self, frame_id: str, stamp_ns: int) -> Transform:
        """
        Return the pose of a frame in the map at a time; 0: at the newest at which it is known.

        Raises
        ------
        PoseError
            If there is no transform.

        """
        check_kind('frame_id', frame_id, str)
        stamp_ns = as_whole('stamp_ns', stamp_ns)
        if frame_id == self.map_frame:
            return np.eye(4)
        fixed = self.config.frames.fixed
        if frame_id == fixed:
            return self.T_map_fixed
        at_ns = stamp_ns or self.transforms.newest_between(fixed, frame_id) or 0
        return self._pipeline.aligner.to_map(self.transforms.lookup(fixed, frame_id, at_ns))

    @property
    def map_frame(self) -> str:
        """
        The frame of the map: that of the poses, unless it is given its own.

        ``align.map_frame`` does so; with ``map.origin`` it is ``frames.fixed`` and _local.
        """
        return self._pipeline.map_frame

    def surfels(self, level: int = 0) -> Surfels:
        """
        Return the surfels with ``map.min_points`` points.

        Parameters
        ----------
        level : int
            Voxels are 2^level times larger than those of the map.

        """
        surfel_map = self.map.coarsen(level) if as_whole('level', level) else self.map
        return surfel_map.surfels(self.config.map.min_points)

    def clear_region(self, region: Region) -> npt.NDArray[np.int32]:
        """
        Empty the voxels whose centres are in a region, for good.

        The scans of the window lose them too, so that later evictions stay exact.

        Returns
        -------
        (E, 3) int32
            Indices of the surfels (``map.min_points``) that were removed.

        """
        check_kind('region', region, Region)
        voxel_index = self.map.moments().voxel_index
        centers = (voxel_index.astype(np.float64) + 0.5) * self.map.voxel_size_m
        inside = voxel_index[region.contains(centers)]
        self._pipeline.layers.clear_region(region.contains)
        return self._pipeline.drop_voxels(inside)

    def restore(self, surfel_map: SurfelMap, scans: Iterable[WindowedScan]) -> None:
        """
        Replace map and window by a saved map and the scans of its window.

        Loops are closed only among the scans that come after it.

        Raises
        ------
        MapError
            If it has another voxel size, level, origin or other columns. Nothing has changed then.

        """
        check_kind('surfel_map', surfel_map, SurfelMap)
        scans = checked_scans(scans)
        for name in ('voxel_size_m', 'level', 'columns'):
            value, expected = getattr(surfel_map, name), getattr(self.map, name)
            if value != expected:
                raise MapError(f'map with {name} {value}, expected {expected} as configured')
        moments = surfel_map.moments()  # before clearing: it may be the map of this mapper
        self._pipeline.origin.take_from(surfel_map)
        self._pipeline.restore(moments, scans)

    def reconfigure(self, config: Config) -> None:
        """
        Change settings while running, from the next scan on.

        Raises
        ------
        ConfigError
            If a setting differs that is not live, or ``filters`` names a file
            that holds no chain. Nothing has changed then.

        """
        check_kind('config', config, Config)
        old, new = self.config.to_mapping(), config.to_mapping()
        for declared in declarations():
            if not declared.live and old[declared.name] != new[declared.name]:
                raise ConfigError(
                    f'{declared.name}: cannot change while running; set it at the start'
                )
        self._pipeline.reconfigure(config)

    def warm_up(self) -> None:
        """Compile the kernels that the settings need to map scans and to derive surfels."""
        run_stages(self.warm_up_stages())

    def warm_up_stages(self) -> list[CompileStage]:
        """
        Return the stages of ``warm_up``, for callers that have more to compile.

        They change nothing of the mapper. Kernels that few inputs need are compiled when they are
        called first: for voxels of 65536 points of one scan, or after ``~/clear_polygon``.
        """
        return self._pipeline.warm_up_stages()

    def summary(self) -> dict[str, Any]:
        """Return counts, times and figures of the map, for files, reports and diagnostics."""
        return {
            **self.counters.summary(),
            'filter_chain': self.chain.to_list(),
            **({'registration': self.registered.summary()} if self.registered else {}),
            'voxel_size_m': self.map.voxel_size_m,
            'origin_m': self.map.origin_m.tolist(),
            'window_scans': len(self.window),
            'mount_changes': self.mount_changes,
            'voxels': self.map.num_voxels,
            'surfels': len(self.map.surfels(self.config.map.min_points)),
            'digest': self.map.digest(),
            **self._pipeline.layers.summary(),
        }
