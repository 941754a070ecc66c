# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
DistanceField: a truncated signed distance field to fuse, query, mesh, save and load.

The one class that users of the library need; the layer of a mapper offers its own as
``mapper.tsdf.field``. It holds no voxels itself: see tsdf/blocks.py for the storage.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_path, as_whole, check_kind
from surfel_mapper.config import TsdfConfig
from surfel_mapper.files.tsdf_state import load_tsdf, save_tsdf
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.euclidean import EuclideanField
from surfel_mapper.tsdf.integrator import Integrator
from surfel_mapper.tsdf.measurements import checked_column, checked_points, Integrated
from surfel_mapper.tsdf.mesh import Mesh, Mesher
from surfel_mapper.tsdf.point_integrator import PointIntegrator
from surfel_mapper.tsdf.queries import labels_at, sample, states
from surfel_mapper.tsdf.range_image import from_depth
from surfel_mapper.tsdf.sensors import CameraModel


class DistanceField:
    """
    A truncated signed distance field.

    Attributes
    ----------
    config : TsdfConfig
        The settings.
    blocks : BlockMap
        The voxels.
    point_integrator, image_integrator : PointIntegrator, Integrator
        Fuse points, and images.
    mesher : Mesher
        Keeps the mesh.

    Parameters
    ----------
    config : TsdfConfig, optional
        The settings ``layers.tsdf.*``; defaults if not given.
    blocks : BlockMap, optional
        Existing voxels, whose settings then count; empty by default.

    Examples
    --------
    >>> import numpy as np
    >>> from surfel_mapper.config import TsdfConfig
    >>> field = DistanceField(TsdfConfig(voxel_size_m=0.1))
    >>> x, y = np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-1, 1, 80))
    >>> _ = field.add(np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1), np.eye(4))
    >>> bool(abs(np.median(field.mesh().vertices[:, 2]) - 2.0) < 0.02)  # a wall at z = 2 m
    True

    """

    def __init__(
        self, config: TsdfConfig | None = None, *, blocks: BlockMap | None = None
    ) -> None:
        if config is not None:
            check_kind('config', config, TsdfConfig, hint='TsdfConfig(voxel_size_m=0.1)')
        if blocks is not None:
            check_kind('blocks', blocks, BlockMap)
        self.blocks = BlockMap(config or TsdfConfig()) if blocks is None else blocks
        self.config = self.blocks.config
        self.mesher = Mesher(self.blocks)
        self.point_integrator = PointIntegrator(self.blocks)
        self.image_integrator = Integrator(self.blocks)

    def __repr__(self) -> str:
        """Return voxel size and number of blocks."""
        return f'DistanceField({self.config.voxel_size_m:g} m: {len(self)} blocks)'

    def __len__(self) -> int:
        """Return the number of blocks."""
        return self.blocks.num_blocks

    def add(
        self,
        points: npt.NDArray[Any],
        T_map_sensor: npt.NDArray[np.float64],
        *,
        stamp_ns: int = 0,
        colors: npt.NDArray[np.uint8] | None = None,
        labels: npt.NDArray[Any] | None = None,
    ) -> Integrated:
        """
        Fuse the points of a scan.

        Parameters
        ----------
        points : (N, 3) float32 or float64
            In the frame of the sensor, m; non-finite points are skipped.
        T_map_sensor : (4, 4) float64
            Pose of the sensor in the map frame.
        stamp_ns : int
            Stamp of the scan, ns.
        colors : (N, 3 or 4) uint8, optional
            Red, green, blue of each point; a fourth channel of 0 means unknown.
        labels : (N,) int, optional
            Label of each point, -1 for unknown.

        Raises
        ------
        CloudFormatError, PoseError, MapLimitError
            If a shape does not match, the pose is not rigid, or the map cannot hold the scan; the
            field is unchanged.

        """
        points = checked_points(points)
        num = len(points)
        colors = checked_column('colors', colors, np.uint8, ((num, 3), (num, 4)))
        labels = checked_column('labels', labels, np.integer, ((num,),))
        return self.point_integrator.integrate(
            points, T_map_sensor, as_whole('stamp_ns', stamp_ns), colors=colors, labels=labels
        )

    def add_depth(
        self,
        depth: npt.NDArray[Any],
        camera: CameraModel,
        T_map_camera: npt.NDArray[np.float64],
        *,
        stamp_ns: int = 0,
        color: npt.ArrayLike | None = None,
        label: npt.ArrayLike | None = None,
        mask: npt.ArrayLike | None = None,
        scale: float | None = None,
        unknown: float | None = None,
        allocate_blocks: bool = True,
    ) -> Integrated:
        """
        Fuse a depth image.

        Parameters
        ----------
        depth : (rows, columns) float32, float64 in m, or uint16 in mm
            Depth along z; 0, nan and 65535 mm mean unknown, inf free up to max_range_m.
        camera : CameraModel
            Model of the camera, z ahead.
        T_map_camera : (4, 4) float64
            Pose of the camera in the map frame.
        stamp_ns : int
            Stamp of the image, ns.
        color : (rows, columns, 3 or 4) uint8, optional
            Red, green, blue of each pixel.
        label : (rows, columns) int, optional
            Label of each pixel, -1 for unknown.
        mask : (rows, columns) bool or int, optional
            Non-zero pixels only free space and leave no surface.
        scale : float, optional
            Metres of one unit of depth; 1 for floats and 0.001 for uint16 by default.
        unknown : float, optional
            A depth that means unknown, in units of the image; 65535 for uint16 by default.
        allocate_blocks : bool
            False: only blocks that the field already has are updated.

        Raises
        ------
        CloudFormatError, PoseError, MapLimitError
            As add.

        """
        check_kind('camera', camera, CameraModel)
        image = from_depth(camera, depth, scale=scale, unknown=unknown)
        image = image.with_images(color=color, label=label, mask=mask)
        return self.image_integrator.integrate(
            image,
            T_map_camera,
            as_whole('stamp_ns', stamp_ns),
            allocate_blocks=allocate_blocks,
        )

    def sample(self, points: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Return the signed distances at (P, 3) points, map frame, (P,) m; nan if unknown."""
        return sample(self.blocks, points).distance

    def gradient(self, points: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Return the gradients of the distance at (P, 3) points, (P, 3); nan if unknown."""
        return sample(self.blocks, points).gradient

    def labels_at(
        self, points: npt.ArrayLike
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
        """
        Return the labels at (P, 3) points, map frame, and their leads; -1 and 0 if uncertain.

        A lead is the number of measurements by which a label is ahead of all others.

        Raises
        ------
        ValueError
            If the field keeps no labels (``semantics: none``).

        """
        return labels_at(self.blocks, points)

    def states(self, points: npt.ArrayLike) -> npt.NDArray[np.uint8]:
        """Return the states at (P, 3) points: UNKNOWN, FREE or OCCUPIED of tsdf.queries, (P,)."""
        return states(self.blocks, points)

    def esdf(self, *, max_m: float = 2.0) -> EuclideanField:
        """
        Return the Euclidean distances from all voxels to obstacles; ``update`` renews them.

        Parameters
        ----------
        max_m : float
            Distances are exact up to this, m.

        Raises
        ------
        ConfigError
            If max_m is not between 1 and 127 voxels.
        MapLimitError
            If the blocks span too many voxels.

        """
        distances = EuclideanField(self.blocks, max_m=max_m)
        distances.update()
        return distances

    def mesh(self) -> Mesh:
        """Return the surface as triangles; only changed blocks are meshed again."""
        self.mesher.update()
        return self.mesher.mesh()

    def save(self, path: str | Path, *, compress: bool = False) -> None:
        """
        Write the field to a file, whole or not at all.

        Raises
        ------
        FileFormatError
            If the file cannot be written.

        """
        check_kind('compress', compress, int, hint='True or False')
        save_tsdf(as_path(path), self.blocks, compress=compress)

    @classmethod
    def load(cls, path: str | Path, config: TsdfConfig) -> DistanceField:
        """
        Return a saved field, which continues as if it had never stopped.

        Raises
        ------
        FileFormatError
            If the file cannot be read, is damaged, or has another voxel size, block, truncation
            or channels than the configuration.

        """
        check_kind('config', config, TsdfConfig, hint='TsdfConfig(voxel_size_m=0.1)')
        return cls(blocks=load_tsdf(as_path(path), config))
