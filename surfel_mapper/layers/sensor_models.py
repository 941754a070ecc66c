# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The place of the sensor of each scan, its camera, and its measurements: points, free rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config, TsdfConfig
from surfel_mapper.errors import PoseError
from surfel_mapper.geometry import Transform
from surfel_mapper.mapping.channels import missing_columns, quantised
from surfel_mapper.poses.buffer import TransformBuffer
from surfel_mapper.scan import Scan
from surfel_mapper.tsdf.range_image import from_depth, RangeImage
from surfel_mapper.tsdf.sensors import CameraModel

MAX_CAMERAS = 8
"""Cameras whose tables of rays are kept, 5 MB each at 640 x 480."""


class SensorModels:
    """
    The sensors of the scans so far.

    Parameters
    ----------
    config : TsdfConfig
        Ranges of cameras, and the frame of the lidar.
    transforms : TransformBuffer, optional
        Tree of frames, in which ``sensor_frame`` is looked up.

    """

    def __init__(self, config: TsdfConfig, transforms: TransformBuffer | None = None) -> None:
        self._config = config
        self._transforms = transforms
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
        ranges = self._config.min_range_m, self._config.max_range_m
        return camera_model(scan.camera, *ranges) if scan.camera else None

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


@lru_cache(MAX_CAMERAS)
def camera_model(camera: tuple[float, ...], min_range_m: float, max_range_m: float) -> CameraModel:
    """Return the model of a camera, whose tables of rays are made once."""
    columns, rows, fx, fy, cx, cy = camera
    return CameraModel(
        columns=int(columns),
        rows=int(rows),
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        min_range_m=min_range_m,
        max_range_m=max_range_m,
    )


def seen_from(T_scan_sensor: Transform, scan: Scan) -> Scan:
    """Return a scan with points and free rays in the frame of its sensor."""
    R, center = T_scan_sensor[:3, :3], T_scan_sensor[:3, 3]
    points = ((scan.points - center) @ R).astype(scan.points.dtype)
    return replace(scan, points=points, free=None if scan.free is None else scan.free @ R)


def range_image(
    scan: Scan, sensor: CameraModel, *, has_color: bool, has_label: bool
) -> RangeImage | None:
    """
    Return the range image of a scan; None if its depth image lacks what its points have.

    Parameters
    ----------
    scan : Scan
        In the frame of its sensor.
    sensor : CameraModel
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
        or (has_color and depth.color is None and not missing_columns(columns, ('rgb',)))
        or (has_label and depth.label is None and 'label' in columns)
    ):
        return None
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
    if labels is not None and num_free:
        labels = np.concatenate([labels, np.full(num_free, -1, np.int32)])  # wider if unsigned
    return points, {'colors': colors, 'labels': labels}


def measured(scan: Scan, max_range_m: float) -> npt.NDArray[Any]:
    """Return the points of a scan, then a point beyond the range on each ray that met nothing."""
    if scan.free is None:
        return scan.points
    beyond = 2.0 * max_range_m * scan.free
    return np.concatenate([scan.points, beyond.astype(scan.points.dtype)])


def two_beams(dtype: Any) -> npt.NDArray[Any]:
    """Return simulated points of a lidar of two beams in a round room, to compile kernels with."""
    azimuth, z = np.meshgrid(np.linspace(-3.0, 3.0, 64), [-0.3, 0.3])
    xyz = np.stack([3.0 * np.cos(azimuth), 3.0 * np.sin(azimuth), z], axis=-1)
    return np.asarray(xyz.reshape(-1, 3), dtype)


def colors_of(scan: Scan) -> npt.NDArray[np.uint8] | None:
    """
    Return the colours of the points: (N, 3), or (N, 4) with a fourth value of 0 if unknown.

    Alpha marks the points that have a colour, unless it is 0 everywhere, as some drivers leave it.
    """
    columns = scan.columns
    if missing_columns(columns, ('rgb',)):
        return None
    colors = quantised(columns, ('rgb',), len(scan)).astype(np.uint8)
    packed = columns.get('rgba') if 'rgb' not in columns else None
    if packed is None or packed.dtype != np.uint32 or not (packed >> 24).any():
        return colors
    return np.column_stack([colors, (packed >> 24).astype(np.uint8)])
