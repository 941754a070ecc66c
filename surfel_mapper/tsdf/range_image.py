# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
RangeImage: the measurements of a depth image, or of the points of a depth camera, by pixel.

See tsdf/kernels/range_image.py for the values of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import Record
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.tsdf.kernels import range_image as kernels
from surfel_mapper.tsdf.measurements import checked_labels
from surfel_mapper.tsdf.sensors import CameraModel

Float32 = npt.NDArray[np.float32]

CLEARING_M = 2e3
"""A clearing pixel holds max_range_m plus this, which is more than any truncation."""


NO_DEPTH_MM = 65535.0
"""Value of pixels without depth in images of mm of some cameras."""


@dataclass(frozen=True, kw_only=True, repr=False)
class RangeImage(Record):
    """
    Ranges in the pixels of a sensor, with optional colours, labels and mask.

    Attributes
    ----------
    sensor : CameraModel
        The sensor model that defines the pixels.
    range_m : (rows, columns) float32
        Length of each ray, m; 0 means unknown, more than max_range_m free up to there.
    largest_m : float
        The largest range, at most max_range_m; 0 for an image without ranges.
    color : (rows, columns, 3 or 4) uint8, optional
        Red, green, blue; a fourth channel of 0 means unknown.
    label : (rows, columns) int32, optional
        -1 means unknown.
    mask : (rows, columns) uint8, optional
        1 for pixels that only free space, for example of moving objects.

    """

    sensor: CameraModel
    range_m: Float32
    largest_m: float
    color: npt.NDArray[np.uint8] | None = None
    label: npt.NDArray[np.int32] | None = None
    mask: npt.NDArray[np.uint8] | None = None

    def with_images(
        self,
        *,
        color: npt.ArrayLike | None = None,
        label: npt.ArrayLike | None = None,
        mask: npt.ArrayLike | None = None,
    ) -> RangeImage:
        """
        Return a copy with a colour image, labels or a mask of the same size.

        Parameters
        ----------
        color : (rows, columns, 3 or 4) uint8, optional
            Red, green, blue; a fourth channel of 0 means unknown.
        label : (rows, columns) int, optional
            From -1, for unknown, to 2^24 - 1.
        mask : (rows, columns) bool or int, optional
            Non-zero pixels only free space and leave no surface.

        Raises
        ------
        CloudFormatError
            If an image is of another size or type.

        """
        more: dict[str, Any] = {}
        if color is not None:
            image = np.asarray(color)
            channels = 4 if image.shape[-1:] == (4,) else 3
            more['color'] = self._fitted('color', image, (channels,))
            if more['color'].dtype != np.uint8:
                raise CloudFormatError(f'color: {more["color"].dtype}, expected uint8')
        if label is not None:
            image = self._fitted('label', np.asarray(label), ())
            more['label'] = checked_labels('label', image)
        if mask is not None:
            more['mask'] = (self._fitted('mask', np.asarray(mask), ()) != 0).astype(np.uint8)
        return replace(self, **more)

    def _fitted(
        self, name: str, image: npt.NDArray[Any], channels: tuple[int, ...]
    ) -> npt.NDArray[Any]:
        expected = (self.sensor.rows, self.sensor.columns, *channels)
        if image.shape != expected:
            raise CloudFormatError(f'{name}: {image.shape}, expected {expected} as the sensor has')
        return np.ascontiguousarray(image)


def from_depth(
    sensor: CameraModel,
    depth: npt.NDArray[Any],
    *,
    scale: float | None = None,
    unknown: float | None = None,
) -> RangeImage:
    """
    Return the range image of a depth image.

    Parameters
    ----------
    sensor : CameraModel
        Model of the camera.
    depth : (rows, columns) float32, float64 or uint16
        Depth along z. Floats are in m; 0, negative and nan mean unknown, inf free up to
        max_range_m. uint16 is in mm; 0 and 65535, which Kinects write, mean unknown.
    scale : float, optional
        Metres of one unit; 1 for floats and 0.001 for uint16 by default.
    unknown : float, optional
        A depth, in the units of the image, that means unknown; 65535 for uint16 by default.

    Raises
    ------
    CloudFormatError
        If the size differs from the sensor model, or the type is not supported.

    """
    if depth.shape != (sensor.rows, sensor.columns):
        raise CloudFormatError(
            f'depth image of {depth.shape}, expected {(sensor.rows, sensor.columns)} as the '
            'camera has (rows, columns)'
        )
    native_type = depth.dtype.newbyteorder('=')
    if native_type not in (np.float32, np.float64, np.uint16):
        raise CloudFormatError(f'depth: {depth.dtype}, expected float32, float64 or uint16')
    if scale is None:
        scale = 1e-3 if native_type == np.uint16 else 1.0
    if not 0.0 < scale < np.inf:
        raise CloudFormatError(f'scale: {scale}, expected a positive number of metres')
    image = np.empty((sensor.rows, sensor.columns), np.float32)
    native = np.ascontiguousarray(depth, native_type)
    absent = NO_DEPTH_MM if native_type == np.uint16 else np.nan
    absent = absent if unknown is None else float(unknown)
    largest = kernels.from_depth(
        native, np.float32(scale), absent, sensor.ray_length, limits(sensor), image
    )
    return RangeImage(sensor=sensor, range_m=image, largest_m=float(largest))


def from_points(
    sensor: CameraModel,
    points: npt.NDArray[Any],
    *,
    colors: npt.NDArray[np.uint8] | None = None,
    labels: npt.NDArray[Any] | None = None,
) -> RangeImage:
    """
    Return the range image of points in any order; each pixel takes its nearest point.

    Parameters
    ----------
    sensor : CameraModel
        Model of the sensor.
    points : (N, 3) float32 or float64
        In the frame of the sensor, m; points not finite or out of view are left out.
    colors : (N, 3 or 4) uint8, optional
        Red, green, blue of each point; a fourth channel of 0 means unknown.
    labels : (N,) int, optional
        Label of each point, -1 for unknown.

    Raises
    ------
    CloudFormatError
        If a shape or type is not as above.

    """
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype not in (np.float32, np.float64):
        raise CloudFormatError(f'points: {points.dtype} {points.shape}, expected (N, 3) float')
    image = np.zeros((sensor.rows, sensor.columns), np.float32)
    source = np.full((sensor.rows, sensor.columns), -1, np.int32)
    largest = kernels.from_points(
        np.ascontiguousarray(points), sensor.projection, limits(sensor), image, source
    )
    range_image = RangeImage(sensor=sensor, range_m=image, largest_m=float(largest))
    more: dict[str, npt.NDArray[Any]] = {}
    if colors is not None:
        channels = 4 if colors.shape[-1:] == (4,) else 3
        more['color'] = image_of('colors', colors, (len(points), channels), source, 0)
    if labels is not None:
        more['label'] = image_of('labels', labels, (len(points),), source, -1)
    return range_image.with_images(**more) if more else range_image


def limits(sensor: CameraModel) -> Float32:
    """Return the smallest and largest range, and the value of a clearing pixel, m, (3,)."""
    farthest = sensor.max_range_m
    return np.array([sensor.min_range_m, farthest, farthest + CLEARING_M], np.float32)


def image_of(
    name: str,
    values: npt.NDArray[Any],
    shape: tuple[int, ...],
    source: npt.NDArray[np.int32],
    missing: int,
) -> npt.NDArray[Any]:
    """Return an image of point values: of the point that each pixel took its range from."""
    if values.shape != shape:
        raise CloudFormatError(f'{name}: {values.shape}, expected {shape} one for each point')
    if not len(values):
        return np.full(source.shape + shape[1:], missing, values.dtype)
    image = values[source]
    image[source < 0] = missing
    return image
