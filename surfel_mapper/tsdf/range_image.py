# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""RangeImage: the measurements of a depth image by pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import Record
from surfel_mapper.errors import CloudFormatError
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
    if unknown is None:
        unknown = NO_DEPTH_MM if native_type == np.uint16 else np.nan
    range_m = depth.astype(np.float32) * np.float32(scale) * sensor.ray_length
    range_m[depth == unknown] = np.nan
    return from_ranges(sensor, range_m)


def from_ranges(sensor: CameraModel, range_m: Float32) -> RangeImage:
    """Return the range image of measured ranges (rows, columns); nan means unknown."""
    nearest, farthest = np.float32(sensor.min_range_m), np.float32(sensor.max_range_m)
    image = np.where(range_m > farthest, np.float32(farthest + CLEARING_M), range_m)
    image[~(range_m >= nearest)] = 0.0
    return RangeImage(sensor=sensor, range_m=image, largest_m=float(min(image.max(), farthest)))
