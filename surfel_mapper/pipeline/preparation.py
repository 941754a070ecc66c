# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Preparation: what is done to a scan before it is reduced.

Deskewed, joined with images, filtered, aligned to the map where poses come from there. A scan
that the motion gate, the filters or the alignment leave out is counted.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

from surfel_mapper.alignment.registration import RegistrationResult
from surfel_mapper.config import Config
from surfel_mapper.counters import Counters, Laps
from surfel_mapper.errors import (
    AlignmentError,
    CloudFormatError,
    FilterError,
    MapError,
    PoseError,
)
from surfel_mapper.filters.chain import Chain
from surfel_mapper.geometry import Transform
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow
from surfel_mapper.pipeline.drops import Drops
from surfel_mapper.pipeline.motion_gate import stands_still
from surfel_mapper.pipeline.registered_poses import RegisteredPoses
from surfel_mapper.pipeline.scan_images import ScanImages
from surfel_mapper.pipeline.scan_poses import ScanPoses
from surfel_mapper.pipeline.window_aligner import WindowAligner
from surfel_mapper.scan import PointTimes, Scan
from surfel_mapper.sensors.deskew import warm_up as warm_up_deskewing
from surfel_mapper.sensors.free_rays import free_directions


@dataclass(frozen=True)
class Prepared:
    """
    A scan that is ready for the map.

    Attributes
    ----------
    scan : Scan
        Deskewed.
    filtered : Scan
        What the filters left of it.
    T_map_sensor : (4, 4) float64
        Where it was taken.
    registration : RegistrationResult, optional
        How it was aligned to the map, where poses come from there.

    """

    scan: Scan
    filtered: Scan
    T_map_sensor: Transform
    registration: RegistrationResult | None = None


class Preparation:
    """
    Prepares one scan after the other.

    Parameters
    ----------
    config : Config
        All settings; may be replaced by ``reconfigure``.
    poses : ScanPoses
        Of the sensors.
    surfel_map : SurfelMap
        What scans are aligned to.
    window : SlidingWindow
        The scans in it.
    aligner : WindowAligner
        How alignment has moved the map against the poses that come in.
    counters : Counters
        What was done.
    drops : Drops
        What was not.

    """

    def __init__(
        self,
        config: Config,
        poses: ScanPoses,
        surfel_map: SurfelMap,
        window: SlidingWindow,
        aligner: WindowAligner,
        counters: Counters,
        drops: Drops,
    ) -> None:
        """Load the filters."""
        self._config = config
        self._poses = poses
        self._map = surfel_map
        self._window = window
        self._aligner = aligner
        self._counters = counters
        self._drops = drops
        self.chain = Chain.load(config.filters) if config.filters else Chain()
        self.images = ScanImages(config.tsdf)

    @property
    def is_trivial(self) -> bool:
        """Whether scans go as they are to where their pose says."""
        config = self._config
        is_changed = len(self.chain) or config.deskew.enabled or config.tsdf.enabled
        return not is_changed and self._poses.registered is None

    def reconfigure(self, config: Config) -> None:
        """
        Take new settings.

        Raises
        ------
        ConfigError
            If ``filters`` names a file that holds no chain; nothing has changed then.

        """
        if config.filters != self._config.filters:
            chain = Chain.load(config.filters) if config.filters else Chain()
            chain.warm_up()
            self.chain = chain
        self._config = config

    def warm_up(self) -> None:
        """Compile every kernel that is needed here."""
        self.chain.warm_up()
        if self._config.deskew.enabled:
            warm_up_deskewing()
        if self._poses.registered is not None:
            self._poses.registered.warm_up()

    def prepare(self, scan: Scan, pose: Transform, laps: Laps) -> Prepared | None:
        """
        Deskew, filter and align a scan; None if it is left out.

        Parameters
        ----------
        scan : Scan
            As it came in.
        pose : (4, 4) float64
            T_map_sensor, as its pose says.
        laps : Laps
            Times what is done.

        """
        if self._poses.registered is None and self._is_gated(pose):
            return None
        times = scan.times
        if times is not None:
            scan = self._poses.deskewed(scan, times)
            laps.end('deskew')
        if self._config.tsdf.enabled or self._config.dynamic.clear:
            scan = self._with_surroundings(scan)
            laps.end('images')
        filtered: Scan | None = scan
        if len(self.chain):
            filtered = self._filter(scan, pose)
            laps.end('filter')
        if filtered is None:
            return None
        prepared = Prepared(scan, filtered, pose)
        if self._poses.registered is None:
            return prepared
        aligned = self._aligned(self._poses.registered, prepared, times)
        laps.end('register')
        return None if aligned is None or self._is_gated(aligned.T_map_sensor) else aligned

    def _aligned(
        self, registered: RegisteredPoses, prepared: Prepared, times: PointTimes | None
    ) -> Prepared | None:
        """Return a scan at the pose where it fits the map; None if it fits nowhere."""
        scan = prepared.scan
        try:
            pose, registration = registered.find(
                prepared.filtered, times, self._map, self._aligner.T_map_fixed
            )
        except (AlignmentError, MapError, PoseError) as error:
            self._drops.scan(scan, 'not_aligned', str(error))
            return None
        if registration is not None and len(registration.degenerate):
            num = len(registration.degenerate)
            self._drops.warn(
                'degenerate',
                f'scan at {scan.stamp_ns / 1e9:.6f} s: what it sees leaves {num} of 6 directions '
                'of motion open; there the prediction is kept',
            )
        T_map_sensor = self._aligner.to_map(pose)
        return replace(prepared, T_map_sensor=T_map_sensor, registration=registration)

    def _with_surroundings(self, scan: Scan) -> Scan:
        """Return a scan with what layers want beside its points, before any is left out."""
        if scan.free is None:
            scan = replace(scan, free=free_directions(scan))
        try:
            scan, missing = self.images.joined(
                scan, lambda image: self._poses.seen_from(image.frame_id, image.stamp_ns, scan)
            )
        except (CloudFormatError, PoseError) as error:
            self._drops.warn('images', f'scan at {scan.stamp_ns / 1e9:.6f} s: {error}')
            return scan
        for kind in missing:
            self._drops.warn(
                f'no_{kind}_image',
                f'scan at {scan.stamp_ns / 1e9:.6f} s: no {kind} image within '
                f'{self._config.tsdf.image_tolerance_s:g} s; layers.tsdf.image_tolerance_s '
                'allows more',
            )
        return scan

    def _is_gated(self, pose: Transform) -> bool:
        """Return whether the motion gate leaves out a scan at a pose, and count it."""
        last = self._window.newest
        if last is None or not stands_still(last.T_map_sensor, pose, self._config.window):
            return False
        self._counters.gated += 1
        return True

    def _filter(self, scan: Scan, pose: Transform) -> Scan | None:
        """Return what the chain leaves of a scan; None where it leaves nothing, or cannot work."""
        T_base_sensor = self._poses.of_base(scan)  # the filters that need it say if it lacks
        try:
            filtered, steps = self.chain.run(
                replace(scan, T_base_sensor=T_base_sensor, T_map_sensor=pose)
            )
        except FilterError as error:
            self._drops.scan(scan, 'filter', str(error))
            return None
        for step in steps:
            self._counters.add_filter(*astuple(step))
        self._counters.points_left_out['filtered'] += len(scan) - len(filtered)
        if not len(filtered):
            self._drops.scan(scan, 'filtered_out', 'the filters left none of its points')
            return None
        return filtered
