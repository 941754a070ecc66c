# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fifteen seconds of a drive as an animation: the surfels of the last scans, from behind the sensor.

A lidar in a simulated street gives ten scans a second, one a frame. Each is added to the map and
the one 60 scans before is removed, so the map moves with the sensor. Surfels are shaded by normal
and light, the points of the scan are orange, the trajectory red. Far discs are hazy.

    python examples/drive_animation.py drive.webp
"""

import argparse
from collections import deque
from pathlib import Path

import numpy as np
from PIL import Image

from surfel_mapper import SurfelMap
from surfel_mapper.simulation import Lidar, Simulation, World
from surfel_mapper.viz.discs import DrawnDiscs, shaded
from surfel_mapper.viz.rendering import Camera, rendered

WINDOW, VOXEL_SIZE_M, FRAME_MS, QUALITY = 60, 0.3, 100, 8
BEHIND_M, ABOVE_M, AHEAD_M, BELOW_M = 11.0, 6.0, 14.0, 1.5
WIDTH, HEIGHT, FOCAL_PX = 560, 250, 290.0
ORANGE, RED = (240, 130, 30), (219, 41, 33)

SKY, HAZE_M = (238.0, 241.0, 245.0), 90.0
"""Colour of the background and of the haze, and the distance at which that is complete."""


def camera(poses):
    """Return a camera behind and above the sensor, which looks ahead of it."""
    ahead = np.sum([pose[:3, 0] for pose in list(poses)[-15:]], axis=0)
    ahead[2] = 0.0
    ahead /= np.linalg.norm(ahead)
    place = poses[-1][:3, 3]
    eye = place - BEHIND_M * ahead + [0.0, 0.0, ABOVE_M]
    near = eye - (place + AHEAD_M * ahead - [0.0, 0.0, BELOW_M])
    near /= np.linalg.norm(near)
    right = np.cross([0.0, 0.0, 1.0], near)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(near, right), near])
    return Camera(R, np.zeros(2), WIDTH, HEIGHT, FOCAL_PX, eye)


def balls(points, radius_m, eye_m):
    """Return points as discs that face the eye, a little before the surface that they lie on."""
    away = eye_m - points
    normal = away / np.linalg.norm(away, axis=1)[:, None]
    return DrawnDiscs(points + 0.2 * normal, normal, np.full(len(points), radius_m))


def frame(surfels, points, poses):
    """Return the picture of a map, a scan in its frame, and the trajectory."""
    view = camera(poses)
    way = np.array([pose[:3, 3] for pose in poses]) - [0.0, 0.0, BELOW_M]
    steps = np.arange(0.0, len(way) - 1, 0.05)
    line = np.stack([np.interp(steps, np.arange(len(way)), axis) for axis in way.T], axis=1)
    shown = [
        DrawnDiscs.of(surfels),
        balls(points, 0.07, view.eye_m),
        balls(line, 0.06, view.eye_m),
    ]
    columns = ('position', 'normal', 'radius_m')
    discs = DrawnDiscs(
        *(np.concatenate([getattr(part, name) for part in shown]) for name in columns)
    )
    colours = np.concatenate(
        [
            255.0 * shaded(shown[0].normal),
            np.tile(ORANGE, (len(points), 1)),
            np.tile(RED, (len(line), 1)),
        ]
    )
    haze = np.linalg.norm(discs.position - view.eye_m, axis=1)[:, None] / HAZE_M
    near = haze[:, 0] < 1.0
    hazy = colours + haze**2 * (SKY - colours)
    image, _ = rendered(view, discs.select(near), np.rint(hazy[near]).astype(np.uint8))
    over = 255.0 * image[..., :3] * image[..., 3:] + SKY * (1.0 - image[..., 3:])
    return Image.fromarray(np.rint(over).astype(np.uint8))


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
        points = scan.points[np.isfinite(scan.points).all(axis=1)][::100]
        points = points @ pose[:3, :3].T + pose[:3, 3]
        frames.append(frame(surfel_map.surfels(min_points=3), points, poses))
    pages = {'save_all': True, 'append_images': frames[1:], 'duration': FRAME_MS, 'loop': 0}
    frames[0].save(args.path, **pages, quality=QUALITY)
    print(f'{args.path}: {len(frames)} frames, {len(surfel_map.surfels(min_points=3)):,} surfels')


if __name__ == '__main__':
    main()
