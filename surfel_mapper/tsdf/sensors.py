# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The sensors: which ray each pixel of a range image stands for."""

from surfel_mapper.tsdf.camera import Camera
from surfel_mapper.tsdf.lidar import Lidar

__all__ = ['Camera', 'Lidar', 'Sensor']

Sensor = Camera | Lidar
