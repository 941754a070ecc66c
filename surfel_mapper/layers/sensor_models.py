# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The camera or lidar of each scan, and its measurements: points and free rays.

The model of a lidar is fitted to the first scan of its frame and checked on every scan. If a scan
does not fit, the model is fitted again, at growing intervals while no model fits. In between the
frame has no model, and layers work without one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config, TsdfConfig
from surfel_mapper.errors import CloudFormatError, PoseError
from surfel_mapper.geometry import Transform
from surfel_mapper.mapping.channels import quantised
from surfel_mapper.poses.buffer import TransformBuffer
from surfel_mapper.scan import Scan
from surfel_mapper.tsdf.fitting import best_fit, fit_share, LEAST_FIT
from surfel_mapper.tsdf.range_image import from_depth, from_points, RangeImage
from surfel_mapper.tsdf.sensors import CameraModel, LidarModel

logger = logging.getLogger(__name__)

MISFIT = 0.8 * LEAST_FIT
"""Share of fitting points of a scan below which the model is fitted again."""

FIRST_RETRY, LAST_RETRY = 2, 256
"""Scans until the next fit of a frame without a model; doubled after every failure."""

NUM_CHECKED = 4096
"""Points of a scan that a check looks at."""


MAX_LIDARS = 64
"""Frames whose lidars are kept; frame names may change without end."""

MAX_CAMERAS = 8
"""Cameras whose tables of rays are kept, 5 MB each at 640 x 480."""


@dataclass(slots=True)
class FrameModel:
    """
    The model of one frame.

    Attributes
    ----------
    model : LidarModel or None
        None while no model fits.
    share : float
        Share of fitting points of the last scan.
    retry : int
        Scans between two fits.
    due : int
        Scans until the next fit.

    """

    model: LidarModel | None = None
    share: float = 0.0
    retry: int = FIRST_RETRY
    due: int = 0


class SensorModels:
    """
    The sensors of the scans so far.

    Attributes
    ----------
    frames : dict of str to FrameModel
        The state of each frame with a lidar.

    Parameters
    ----------
    config : TsdfConfig
        Ranges of the sensors, and the frame of the lidar.
    transforms : TransformBuffer, optional
        Tree of frames, in which ``sensor_frame`` is looked up.

    """

    def __init__(self, config: TsdfConfig, transforms: TransformBuffer | None = None) -> None:
        self._config = config
        self._transforms = transforms
        self.frames: dict[str, FrameModel] = {}
        self._cameras: dict[tuple[float, ...], CameraModel] = {}
        self._checked: tuple[Scan | None, LidarModel | None] = (None, None)
        self._centered: tuple[Scan, Scan, Transform | None] | None = None

    @classmethod
    def configured(
        cls, config: Config, transforms: TransformBuffer, mount: Callable[[str], object]
    ) -> SensorModels:
        """
        Return the sensors of a configuration, whose scans come with a tree of frames.

        ``mount`` adds the configured place of a frame to the tree; it is called for the frame of
        the sensor, which no scan has.
        """
        if config.tsdf.sensor_frame:
            mount(config.tsdf.sensor_frame)
        return cls(config.tsdf, transforms)

    def centered(self, scan: Scan, T_map_scan: Transform) -> tuple[Scan, Transform]:
        """
        Return a scan in the frame of its sensor, and the pose of the sensor in the map.

        Parameters
        ----------
        scan : Scan
            In its own frame.
        T_map_scan : (4, 4) float64
            The pose of that frame in the map.

        Raises
        ------
        PoseError
            See pose_in.

        """
        if self._centered is None or self._centered[0] is not scan:
            T_scan_sensor = self.pose_in(scan)
            centered = scan if T_scan_sensor is None else seen_from(T_scan_sensor, scan)
            self._centered = scan, centered, T_scan_sensor  # all layers get one, checked once
        _, centered, T_scan_sensor = self._centered
        return centered, T_map_scan if T_scan_sensor is None else T_map_scan @ T_scan_sensor

    def camera_of(self, scan: Scan) -> CameraModel | None:
        """Return the camera of a scan; None for a cloud of another sensor."""
        return self._camera(scan.camera) if scan.camera else None

    def of(self, scan: Scan) -> CameraModel | LidarModel | None:
        """
        Return the sensor of a scan: its camera, else the lidar of its frame; None if none fits.

        Parameters
        ----------
        scan : Scan
            In the frame of its sensor, see centered.

        """
        if scan.camera:
            return self._camera(scan.camera)
        if self._checked[0] is not scan:  # several layers ask for the same scan
            if scan.frame_id not in self.frames and len(self.frames) >= MAX_LIDARS:
                del self.frames[next(iter(self.frames))]
            frame = self.frames.setdefault(scan.frame_id, FrameModel())
            self._check_fitted(frame, scan)
            self._checked = scan, frame.model
        return self._checked[1]

    def pose_in(self, scan: Scan) -> Transform | None:
        """
        Return the pose of the sensor in the frame of a scan, T_scan_sensor; None: its origin.

        The points of a camera are always given about its centre.

        Raises
        ------
        PoseError
            If ``sensor_frame`` is set and no transform leads from there to the frame of the scan.

        """
        config = self._config
        if scan.camera:
            return None
        if not config.sensor_frame or self._transforms is None:
            return None
        try:
            return self._transforms.lookup(scan.frame_id, config.sensor_frame, scan.stamp_ns)
        except PoseError as error:
            raise PoseError(f'layers.tsdf.sensor_frame: {error}') from error

    def _camera(self, numbers: tuple[float, ...]) -> CameraModel:
        """Return the model of a camera, whose tables of rays are made once."""
        if numbers not in self._cameras:
            if len(self._cameras) >= MAX_CAMERAS:
                del self._cameras[next(iter(self._cameras))]
            width, height, *pinhole = numbers
            angles = dict(zip(('fx', 'fy', 'cx', 'cy'), pinhole, strict=True))
            self._cameras[numbers] = CameraModel(
                columns=int(width), rows=int(height), **angles, **self._ranges
            )
        return self._cameras[numbers]

    @property
    def _ranges(self) -> dict[str, Any]:
        return {'min_range_m': self._config.min_range_m, 'max_range_m': self._config.max_range_m}

    def _check_fitted(self, frame: FrameModel, scan: Scan) -> None:
        """Check the model of a frame on a scan; fit it again if the scan does not fit."""
        if frame.model is not None:
            frame.share = self._share(frame.model, scan)
            if frame.share >= MISFIT:
                return
            logger.warning(
                'dynamic.clear: only %.0f %% of the points in %s fit the sensor of %d x %d rays; '
                'it is fitted again',
                *(100.0 * frame.share, scan.frame_id, frame.model.rows, frame.model.columns),
            )
            frame.model, frame.due, frame.retry = None, 0, FIRST_RETRY
        if frame.due > 0:
            frame.due -= 1
            return
        try:
            frame.model, frame.share = best_fit(
                scan.points,
                scan.columns.get('ring'),
                self._config.voxel_size_m,
                **self._ranges,
            )
        except CloudFormatError:  # fewer than two beams: nothing to fit
            frame.model, frame.share = None, 0.0
        if frame.model is None:
            if frame.retry == FIRST_RETRY:
                logger.warning(
                    'dynamic.clear: no model of a lidar fits the points in %s (%.0f %% of them, '
                    'expected %.0f %%): nothing is cleared by them. For a single lidar set '
                    'layers.tsdf.sensor_frame',
                    *(scan.frame_id, 100.0 * frame.share, 100.0 * LEAST_FIT),
                )
            frame.due, frame.retry = frame.retry, min(2 * frame.retry, LAST_RETRY)
        else:
            frame.retry = FIRST_RETRY

    def _share(self, model: LidarModel, scan: Scan) -> float:
        return fit_share(model, scan.points, self._config.voxel_size_m, num_checked=NUM_CHECKED)


def seen_from(T_scan_sensor: Transform, scan: Scan) -> Scan:
    """Return a scan with points and free rays in the frame of its sensor."""
    R, center = T_scan_sensor[:3, :3], T_scan_sensor[:3, 3]
    points = ((scan.points - center) @ R).astype(scan.points.dtype)
    return replace(scan, points=points, free=None if scan.free is None else scan.free @ R)


def without_sensor(config: TsdfConfig) -> TsdfConfig:
    """Return settings by which the sensor is at the origin of its points."""
    return replace(config, sensor_frame='')


def range_image(
    scan: Scan, sensor: CameraModel | LidarModel, *, has_color: bool, has_label: bool
) -> RangeImage:
    """
    Return the range image of a scan: of its depth image if it has one, else of points and rays.

    Parameters
    ----------
    scan : Scan
        In the frame of its sensor.
    sensor : CameraModel or LidarModel
        The model of it.
    has_color, has_label : bool
        Whether colours and labels are taken, if the scan has any.

    Raises
    ------
    CloudFormatError
        If labels are out of range.

    """
    depth, columns = scan.depth, scan.columns
    if (
        depth is None
        or not isinstance(sensor, CameraModel)
        or (has_color and depth.color is None and ('rgb' in columns or 'rgba' in columns))
        or (has_label and depth.label is None and 'label' in columns)
    ):
        points, channels = measured_channels(
            scan, sensor.max_range_m, has_color=has_color, has_label=has_label
        )
        return from_points(sensor, points, **channels)
    return from_depth(sensor, depth.depth).with_images(
        color=depth.color if has_color else None, label=depth.label if has_label else None
    )


def measured_channels(
    scan: Scan, max_range_m: float, *, has_color: bool, has_label: bool
) -> tuple[npt.NDArray[Any], dict[str, npt.NDArray[Any] | None]]:
    """Return points and free rays of a scan, with their colours and labels if asked for."""
    points = measured(scan, max_range_m)
    num_free = len(points) - len(scan)
    colors = colors_of(scan) if has_color else None
    labels = scan.columns.get('label') if has_label else None
    if colors is not None:
        colors = np.pad(colors, ((0, num_free), (0, 0)))
    if labels is not None:
        labels = np.pad(labels, (0, num_free), constant_values=-1)
    return points, {'colors': colors, 'labels': labels}


def measured(scan: Scan, max_range_m: float) -> npt.NDArray[Any]:
    """Return the points of a scan, then a point beyond the range on each ray that met nothing."""
    if scan.free is None:
        return scan.points
    beyond = 2.0 * max_range_m * scan.free
    return np.concatenate([scan.points, beyond.astype(scan.points.dtype)])


def two_beams(dtype: Any) -> npt.NDArray[Any]:
    """Return simulated points of a lidar of two beams in a round room, to compile kernels with."""
    lidar = LidarModel(rows=2, columns=64, vertical_fov_deg=10.0)
    return np.asarray(3.0 * lidar.directions.reshape(-1, 3), dtype)


def colors_of(scan: Scan) -> npt.NDArray[np.uint8] | None:
    """
    Return the colours of the points: (N, 3), or (N, 4) with a fourth value of 0 if unknown.

    Alpha marks the points that have a colour, unless it is 0 everywhere, as some drivers leave it.
    """
    columns = scan.columns
    if not {'rgb', 'rgba'} & columns.keys():
        return None
    colors = quantised(columns, ('rgb',), len(scan)).astype(np.uint8)
    packed = columns['rgba'] if 'rgb' not in columns else None
    if packed is None or packed.dtype != np.uint32 or not (packed >> 24).any():
        return colors
    return np.column_stack([colors, (packed >> 24).astype(np.uint8)])
