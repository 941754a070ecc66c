# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fifteen seconds of a drive as an animation: the surfels of the last scans, from behind the sensor.

A lidar in a simulated street gives ten scans a second, one a frame. Each is added to the map and
the one 60 scans before is removed, so the map moves with the sensor. Surfels are shaded by normal
and light, the points of the scan are orange, the trajectory red.

A disc is painted as the ellipse that a small disc has in the image: as long as the disc is wide at
its distance, and as narrow as it is turned away. Far discs are painted first, and hazy.

    python examples/drive_animation.py drive.webp
"""

import argparse
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from surfel_mapper import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.simulation import Lidar, Simulation, World
from surfel_mapper.viz.discs import DrawnDiscs, shaded
from surfel_mapper.viz.kernels.painting import paint_discs

WINDOW, VOXEL_SIZE_M, FRAME_MS, QUALITY = 60, 0.3, 100, 30
BEHIND_M, ABOVE_M, AHEAD_M, BELOW_M = 11.0, 6.0, 14.0, 1.5
ORANGE, RED = (240, 130, 30), (219, 41, 33)


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


def camera(poses):
    """Return a camera behind and above the sensor, which looks ahead of it."""
    ahead = np.sum([pose[:3, 0] for pose in list(poses)[-15:]], axis=0)
    ahead[2] = 0.0
    ahead /= np.linalg.norm(ahead)
    place = poses[-1][:3, 3]
    return Camera(
        place=place - BEHIND_M * ahead + [0.0, 0.0, ABOVE_M],
        target=place + AHEAD_M * ahead - [0.0, 0.0, BELOW_M],
    )


def frame(surfels, points, poses):
    """Return the picture of a map, a scan in its frame, and the trajectory."""
    view = camera(poses)
    image = view.image()
    view.paint_surfels(image, surfels)
    view.paint_points(image, points, 0.05, ORANGE)
    way = np.array([pose[:3, 3] for pose in poses]) - [0.0, 0.0, BELOW_M]
    steps = np.arange(0.0, len(way) - 1, 0.05)
    line = np.stack([np.interp(steps, np.arange(len(way)), axis) for axis in way.T], axis=1)
    view.paint_points(image, line, 0.06, RED)
    return Image.fromarray(np.rint(image).clip(0, 255).astype(np.uint8))


def main():
    """Drive, map, draw."""
    parser = argparse.ArgumentParser(description=str(__doc__).strip().partition('\n')[0])
    parser.add_argument('path', type=Path, help='picture to write, .webp or .gif')
    parser.add_argument(
        'scans', type=int, nargs='?', default=150, help='length of the drive (%(default)s)'
    )
    args = parser.parse_args()

    world, lidar = World.street(seed=1, length_m=160.0), Lidar(beams=64, columns=1024)
    street = Simulation(world, lidar, num_scans=args.scans)
    surfel_map = SurfelMap(VOXEL_SIZE_M)
    window, poses, frames = deque(), deque(maxlen=WINDOW), []
    for scan in street.scans():
        pose = street.drive.T_odom_sensor(scan.stamp_ns)
        window.append(surfel_map.add(scan.points, T_map_sensor=pose))
        if len(window) > WINDOW:
            surfel_map.remove(window.popleft())
        poses.append(pose)
        points = scan.points[np.isfinite(scan.points).all(axis=1)][::40]
        points = points @ pose[:3, :3].T + pose[:3, 3]
        frames.append(frame(surfel_map.surfels(min_points=3), points, poses))
    pages = {'save_all': True, 'append_images': frames[1:], 'duration': FRAME_MS, 'loop': 0}
    frames[0].save(args.path, **pages, quality=QUALITY)
    print(f'{args.path}: {len(frames)} frames, {len(surfel_map.surfels(min_points=3)):,} surfels')


if __name__ == '__main__':
    main()
