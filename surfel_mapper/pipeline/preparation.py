# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Preparation of a scan for the map: motion gate, deskewing, images, filters, registration, moments.

A scan that the motion gate, the filters or the registration leave out is refused.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from surfel_mapper.compilation import CompileStage
from surfel_mapper.config import Config, WindowConfig
from surfel_mapper.counters import Laps
from surfel_mapper.errors import CloudFormatError, MapError, PoseError, ScanRefusedError
from surfel_mapper.filters.chain import Chain
from surfel_mapper.geometry import compose, inverse, rotation_angle, Transform
from surfel_mapper.layers import Surroundings
from surfel_mapper.mapping.channels import checked_channels, missing_columns, summed_columns
from surfel_mapper.mapping.moments import point_keys, ScanMoments
from surfel_mapper.mapping.reducer import within
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.pipeline.drops import Drops, GATED
from surfel_mapper.pipeline.local_map import LocalMap
from surfel_mapper.pipeline.mapping_stages import expected_type
from surfel_mapper.pipeline.prepared import Prepared
from surfel_mapper.pipeline.registered_poses import RegisteredPoses
from surfel_mapper.pipeline.scan_images import ScanImages
from surfel_mapper.pipeline.scan_poses import ScanPoses, viewpoint
from surfel_mapper.pipeline.window_aligner import WindowAligner
from surfel_mapper.scan import PointTimes, Scan
from surfel_mapper.sensors.deskew import warm_up as warm_up_deskewing
from surfel_mapper.sensors.free_rays import free_directions


class Preparation:
    """
    Prepares one scan after the other.

    Parameters
    ----------
    config : Config
        All settings; later ones are passed to each call.
    poses : ScanPoses
        The poses of the sensors.
    around : Surroundings
        The map that scans are registered to, and the window, for the motion gate.
    aligner : WindowAligner
        Corrects the poses that come in.
    images : ScanImages, optional
        The images that scans are joined with, if a layer wants any.
    needs_free_rays : bool
        Whether layers need the directions in which the sensor met nothing.
    drops : Drops
        Counts the scans that are left out.

    Attributes
    ----------
    chain : Chain
        The filters.
    local_map : LocalMap or None
        Scans are registered to it instead of the whole map; may be replaced at any time.

    """

    def __init__(
        self,
        config: Config,
        poses: ScanPoses,
        around: Surroundings,
        aligner: WindowAligner,
        images: ScanImages | None,
        needs_free_rays: bool,
        drops: Drops,
    ) -> None:
        self.local_map: LocalMap | None = None
        self._filters = config.filters
        self._poses = poses
        self._around = around
        self._aligner = aligner
        self._images = images
        self._needs_free_rays = needs_free_rays
        self._drops = drops
        self.chain = Chain.load(config.filters) if config.filters else Chain()

    def load_filters(self, path: str) -> None:
        """
        Load the chain of filters of a file, if its path has changed.

        Raises
        ------
        ConfigError
            If the file holds no chain; nothing has changed then.

        """
        if path != self._filters:
            chain = Chain.load(path) if path else Chain()
            chain.warm_up()
            self.chain, self._filters = chain, path

    def warm_up_stages(self, config: Config) -> list[CompileStage]:
        """Return the stages that compile the kernels of preparation, as far as it uses any."""
        stages = []
        if self.chain.filters:
            warm_up = partial(self.chain.warm_up, expected_type(config))
            stages.append(CompileStage('filters', warm_up))
        if config.deskew.enabled:
            stages.append(CompileStage('deskewing', warm_up_deskewing))
        if self._poses.registered is not None:
            stages.append(CompileStage('registration', self._poses.registered.warm_up))
        return stages

    def prepare(
        self,
        scan: Scan,
        pose: Transform,
        config: Config,
        laps: Laps,
    ) -> list[Prepared]:
        """
        Deskew, filter and register a scan; return the scans that can be mapped now.

        None while registration waits for the next scans to confirm its pose; with the scan that
        confirms it, all that have waited.

        Parameters
        ----------
        scan : Scan
            As it came in.
        pose : (4, 4) float64
            T_map_sensor before registration.
        config : Config
            All settings.
        laps : Laps
            Takes the time of each stage.

        Raises
        ------
        ScanRefusedError
            If the motion gate, the filters or registration leave the scan out.
        FilterError
            If a filter cannot work.
        PoseError
            If poses within its sweep were forgotten since it got its own.

        """
        times, registered, gate = scan.times, self._poses.registered, config.window
        is_gated = bool(gate.gate_distance_m or gate.gate_angle_deg)
        if is_gated and registered is None:
            self._check_motion(scan, pose, gate)
        prepared = self._filtered(scan, pose, laps)
        if self._around.surfel_map.columns:
            self._check_columns(prepared.filtered)
        if registered is None:
            return [prepared]
        confirmed = self._register(registered, prepared, times)
        laps.end('register')
        if is_gated and len(confirmed) == 1:  # of several the gate would compare all with one
            self._check_motion(confirmed[0].scan, confirmed[0].T_map_sensor, gate)
        return confirmed

    def _filtered(self, scan: Scan, pose: Transform, laps: Laps) -> Prepared:
        """Return a scan deskewed, joined with images, and filtered, if points are left."""
        if self._needs_free_rays and scan.free is None:  # first: deskewing makes nan of inf
            scan = replace(scan, free=free_directions(scan, self._deskewed))
        if scan.times is not None:
            scan = self._deskewed(scan)
            laps.end('deskew')
        if self._images is not None:
            scan = self._with_images(scan, self._images)
        if self._needs_free_rays or self._images is not None:
            laps.end('images')
        if not self.chain.filters:
            return Prepared(scan, scan, pose)
        seen = replace(scan, T_base_sensor=self._poses.of_base(scan), T_map_sensor=pose)
        filtered, steps = self.chain.run(seen)
        laps.end('filter')
        counters = self._drops.counters
        for step in steps:
            counters.add_filter(step)
        counters.points_left_out['filtered'] += len(scan) - len(filtered)
        if not len(filtered):
            raise ScanRefusedError('filtered_out', 'the filters left none of its points')
        return Prepared(scan, filtered, pose)

    def _deskewed(self, scan: Scan) -> Scan:
        """Return a scan with all points in the sensor frame at its stamp."""
        return scan if scan.times is None else self._poses.deskewed(scan, scan.times)

    def _check_columns(self, scan: Scan) -> None:
        """Raise unless a scan has the columns that the map sums."""
        names = self._around.surfel_map.columns
        missing = missing_columns(scan.columns, names)
        if missing:
            reason = f'its points have no {" and no ".join(missing)}, by images and filters'
            raise ScanRefusedError('missing_column', reason)
        try:
            for name in names:
                checked_channels(scan.columns, name, len(scan))
        except ValueError as error:
            raise ScanRefusedError('bad_cloud', str(error)) from error

    def _register(
        self, poses: RegisteredPoses, prepared: Prepared, times: PointTimes | None
    ) -> list[Prepared]:
        """Return the scans whose places registration knows now."""
        if self.local_map is None:
            target, T_target_fixed = self._around.surfel_map, self._aligner.T_map_fixed
        else:
            target, T_target_fixed = self.local_map.surfel_map, np.eye(4)
        try:
            ready = poses.align(prepared, times, target, T_target_fixed)
        except (MapError, PoseError) as error:
            raise ScanRefusedError('not_aligned', str(error)) from error
        for item in ready:
            if item.registration is not None and len(item.registration.degenerate):
                num = len(item.registration.degenerate)
                self._drops.warn(
                    'degenerate',
                    f'scan at {item.scan.stamp_ns / 1e9:.6f} s: {num} of 6 directions of motion '
                    'are not determined by its points; the prediction is kept in these',
                )
        return [replace(p, T_map_sensor=self._aligner.to_map(p.T_map_sensor)) for p in ready]

    def _with_images(self, scan: Scan, images: ScanImages) -> Scan:
        """Return a scan with columns from images, before points are filtered."""
        try:
            scan, missing = images.joined(
                scan, lambda image: self._poses.seen_from(image.frame_id, image.stamp_ns, scan)
            )
        except (CloudFormatError, PoseError) as error:
            self._drops.warn('images', f'scan at {scan.stamp_ns / 1e9:.6f} s: {error}')
            return scan
        for kind in missing:
            self._drops.warn(
                f'no_{kind}_image',
                f'scan at {scan.stamp_ns / 1e9:.6f} s: no {kind} image within '
                f'{images.wanted.tolerance_s:g} s; {images.wanted.setting} allows more',
            )
        return scan

    def _check_motion(self, scan: Scan, pose: Transform, gate: WindowConfig) -> None:
        """
        Raise if the motion gate leaves out a scan at a pose.

        It is compared with the last scan of its frame: sensors that are mounted apart are not at
        rest, nor in motion, because of the distance between them.
        """
        T_map_last = self._around.window.last_pose(scan.frame_id)
        if T_map_last is not None and stands_still(T_map_last, pose, gate):
            raise ScanRefusedError(GATED)


def stands_still(T_map_last: Transform, T_map_sensor: Transform, gate: WindowConfig) -> bool:
    """Return whether two poses are nearer to each other than the limits of the motion gate."""
    motion = compose(inverse(T_map_last), T_map_sensor)
    distance_m = float(np.sqrt((motion[:3, 3] ** 2).sum()))
    angle_deg = float(np.degrees(rotation_angle(motion)))
    moved = 0.0 < gate.gate_distance_m <= distance_m
    turned = 0.0 < gate.gate_angle_deg <= angle_deg
    return not (moved or turned)


def reduced(
    scan: Scan, T_map_sensor: Transform, surfel_map: SurfelMap, config: Config
) -> WindowedScan:
    """Return a scan as its moments at a pose, with its points if the window keeps them."""
    limits = config.input
    origin: npt.NDArray[np.float64] | None = T_map_sensor[:3, 3]
    if config.pose.source == 'identity':
        origin = viewpoint(T_map_sensor, config)
    moments = surfel_map.reduce(
        scan.points,
        T_map_sensor,
        origin=origin,
        min_range_m=limits.min_range_m,
        max_range_m=limits.max_range_m or np.inf,
        columns=scan.columns,
    )
    windowed = WindowedScan(
        moments=moments,
        stamp_ns=scan.stamp_ns,
        T_map_sensor=T_map_sensor,
        frame_id=scan.frame_id,
    )
    if not config.window.keep_points:
        return windowed
    stay = within(scan.points, limits.min_range_m, limits.max_range_m)
    if 'beyond_map' in moments.left_out:
        stay &= point_keys(scan.points, T_map_sensor, surfel_map.voxel_size_m) >= 0
    entered = scan.select(stay)
    columns = summed_columns(entered.columns, surfel_map.columns)
    return replace(windowed, points=entered.points, columns=columns)


def moments_at(
    scan: WindowedScan, T_map_sensor: Transform, surfel_map: SurfelMap, config: Config
) -> ScanMoments:
    """Return the moments of a scan of the window, whose points are kept, at another pose."""
    assert scan.points is not None, 'only scans with points are moved'
    seen_from = viewpoint(T_map_sensor, config)
    return surfel_map.reduce(scan.points, T_map_sensor, origin=seen_from, columns=scan.columns)
