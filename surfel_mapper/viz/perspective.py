# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Pictures of surfels in perspective, for animations; map.png has views without perspective.

A disc is painted as the ellipse that a small disc has in the image: as long as the disc is wide at
its distance, and as narrow as it is turned away. Far to near, so near discs hide far ones and
none flicker; hazy far away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.viz.discs import DrawnDiscs, shaded
from surfel_mapper.viz.kernels.painting import paint_discs

Array = npt.NDArray[np.float64]

SKY = (238.0, 241.0, 245.0)
"""Colour of the background, and of the haze."""

WIDER = 1.2
"""Discs relative to those of the viewer: gaps between them would flicker from frame to frame."""

THINNEST_PX, EDGE_ON = 0.6, 0.08
"""Smallest half axis of an ellipse, px, and its width relative to its length from the side."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """
    A pinhole camera.

    Attributes
    ----------
    place, target : (3,) float64, m
        Position and direction of view, in the frame of the map; z is up.
    width, height : int, px
    focal_px : float
    nearest_m, haze_m : float
        Nothing is drawn that is nearer, or farther than where the haze is complete.

    """

    place: Array
    target: Array
    width: int = 560
    height: int = 280
    focal_px: float = 330.0
    nearest_m: float = 1.5
    haze_m: float = 90.0

    def image(self) -> npt.NDArray[np.float32]:
        """Return an empty image, (height, width, 3), 0 to 255."""
        return np.tile(np.array(SKY, np.float32), (self.height, self.width, 1))

    def paint_surfels(self, image: npt.NDArray[np.float32], surfels: Surfels) -> None:
        """Paint the surfels that face the camera over an image, shaded by normal and light."""
        discs = DrawnDiscs.of(surfels)
        away = ((discs.position - self.place) * discs.normal).sum(axis=1)
        discs = discs.select(away < 0.0)
        colours = 255.0 * shaded(discs.normal)
        self._paint(image, discs.position, WIDER * discs.radius_m, colours, discs.normal)

    def paint_points(
        self, image: npt.NDArray[np.float32], points: Array, radius_m: float, colour: npt.ArrayLike
    ) -> None:
        """Paint points (N, 3), m, as balls of one colour, 0 to 255, over an image."""
        points = np.asarray(points, np.float64)
        colours = np.broadcast_to(np.asarray(colour, np.float64), points.shape)
        self._paint(image, points, np.full(len(points), radius_m), colours, None)

    def rotation(self) -> Array:
        """Return the axes of the camera, (3, 3): right, up, ahead."""
        ahead = np.asarray(self.target, np.float64) - self.place
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, ahead), ahead])

    def _paint(
        self,
        image: npt.NDArray[np.float32],
        position: Array,
        radius_m: Array,
        colours: Array,
        normal: Array | None,
    ) -> None:
        rotation = self.rotation()
        seen = (position - self.place) @ rotation.T
        chosen = np.flatnonzero((seen[:, 2] > self.nearest_m) & (seen[:, 2] < self.haze_m))
        chosen = chosen[np.argsort(-seen[chosen, 2], kind='stable')]
        haze = (seen[chosen, 2:] / self.haze_m) ** 2
        colours = (1.0 - haze) * colours[chosen] + haze * np.array(SKY)
        turned = None if normal is None else normal[chosen] @ rotation.T
        ellipses = self._ellipses(seen[chosen], radius_m[chosen], turned)
        paint_discs(ellipses, colours.astype(np.float32), image)

    def _ellipses(self, seen: Array, radius_m: Array, normal: Array | None) -> Array:
        """Return column, row, half length and width, and angle of discs, (K, 5), px and rad."""
        depth = seen[:, 2]
        size = self.focal_px * radius_m / depth
        ellipses = np.zeros((len(seen), 5))
        ellipses[:, 0] = 0.5 * (self.width - 1) + self.focal_px * seen[:, 0] / depth
        ellipses[:, 1] = 0.5 * (self.height - 1) - self.focal_px * seen[:, 1] / depth
        ellipses[:, 2:4] = np.maximum(size, THINNEST_PX)[:, None]
        if normal is not None:
            ray = seen / np.linalg.norm(seen, axis=1)[:, None]
            facing = np.abs((normal * ray).sum(axis=1))
            ellipses[:, 3] = np.maximum(size * np.maximum(facing, EDGE_ON), THINNEST_PX)
            ellipses[:, 4] = np.arctan2(normal[:, 0], normal[:, 1])
        return ellipses
