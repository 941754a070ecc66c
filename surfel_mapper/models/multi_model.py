# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""MultiModel: planes, surfaces and Gaussians of a cloud, and clouds sampled from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_real, Record
from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError
from surfel_mapper.models.evaluation import Evaluation, nearest, p95, POINT_BYTES, rms
from surfel_mapper.models.packing import ModelsHeader, pack, unpack, Unpacked
from surfel_mapper.models.primitives import Gaussians, Plane, Surface

__all__ = ['Gaussians', 'MultiModel', 'Plane', 'Surface', 'evaluate', 'read']

Array = npt.NDArray[np.float64]

MOST_BYTES = 1 << 28
"""Size limit of files of models: 15 million Gaussians."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MultiModel(Record):
    """
    Planes, surfaces and Gaussians of one cloud.

    Attributes
    ----------
    planes : list of Plane
    surfaces : list of Surface
    gaussians : Gaussians
        Together they hold every point once.
    labels : (N,) int32
        The id of the primitive of each given point; -1 if the point is not finite.
    voxel_size_m : float
        Edge of the voxels for thinning.
    num_thinned : int
        Points of the thinned cloud.
    milliseconds : dict of str to float
        Duration of each stage.
    noise : (float, float)
        Noise that was used, sigma = noise[0] + noise[1] range^2, m.

    """

    planes: list[Plane]
    surfaces: list[Surface]
    gaussians: Gaussians
    labels: npt.NDArray[np.int32]
    voxel_size_m: float
    num_thinned: int
    milliseconds: dict[str, float] = field(default_factory=dict)
    noise: tuple[float, float] = (0.0, 0.0)

    @property
    def patches(self) -> list[Plane]:
        """Planes, then surfaces."""
        return [*self.planes, *self.surfaces]

    @property
    def size_bytes(self) -> int:
        """Bytes of a file of the models (see packing), 0 without any."""
        return len(self.to_bytes()) if self.patches or len(self.gaussians) else 0

    def to_bytes(
        self,
        versions: Mapping[int, int] | None = None,
        removed: Sequence[int] = (),
        **message: Any,
    ) -> bytes:
        """
        Return the models as bytes, without the labels; see packing.

        Parameters
        ----------
        versions : mapping of int to int, optional
            Versions of the primitives by id; 1 if omitted.
        removed : sequence of int
            Ids that are gone since the previous message.
        message : optional
            number, is_complete, stamp_ns and frame_id of a ModelsHeader.

        Raises
        ------
        ModelError
            If a number is not finite, or too large to be packed.

        """
        header = ModelsHeader(
            voxel_size_m=self.voxel_size_m,
            noise=self.noise,
            num_thinned=self.num_thinned,
            **message,
        )
        return pack(header, (self.planes, self.surfaces), self.gaussians, versions, removed)

    @classmethod
    def from_bytes(cls, data: bytes, name: str | Path = 'bytes') -> MultiModel:
        """
        Return the models in bytes of ``to_bytes``; they have no labels.

        Parameters
        ----------
        data : bytes
            The bytes.
        name : str or Path
            File or topic, for errors.

        Raises
        ------
        FileFormatError
            If they are no models, damaged, of another version, or need too much memory.

        """
        return cls.from_unpacked(unpack(data, name))

    @classmethod
    def from_unpacked(cls, unpacked: Unpacked) -> MultiModel:
        """Return models of primitives; they have no labels."""
        return cls(
            planes=unpacked.planes,
            surfaces=unpacked.surfaces,
            gaussians=unpacked.gaussians,
            labels=np.empty(0, np.int32),
            voxel_size_m=unpacked.header.voxel_size_m,
            num_thinned=unpacked.header.num_thinned,
            noise=unpacked.header.noise,
        )

    def translated(self, offset: npt.ArrayLike) -> MultiModel:
        """Return the models moved by an offset (3,), m; labels and figures stay."""
        by = np.asarray(offset, np.float64)
        gaussians = replace(self.gaussians, mean=self.gaussians.mean + by)
        return replace(
            self,
            planes=[replace(plane, mean=plane.mean + by) for plane in self.planes],
            surfaces=[replace(surface, mean=surface.mean + by) for surface in self.surfaces],
            gaussians=gaussians,
        )

    def resample(self, step_m: float | None = None, seed: int = 0) -> Array:
        """
        Return a cloud (M, 3) sampled from the models, m.

        Its size is bounded by the volume of the models, however many points a map has: see
        Gaussians.sample_counts.

        Parameters
        ----------
        step_m : float, optional
            Spacing of points on planes and surfaces; the voxel size if omitted.
        seed : int
            Seed of the samples of Gaussians.

        Raises
        ------
        ValueError
            If the spacing is not positive and finite.

        """
        step_m = self._step_m(step_m)
        samples = [patch.samples(step_m) for patch in self.patches]
        counts = self.gaussians.sample_counts(self.voxel_size_m)
        return np.concatenate([*samples, self.gaussians.samples(seed, counts)])

    def num_samples(self, step_m: float | None = None) -> int:
        """Return about how many points ``resample`` returns, without sampling them."""
        step_m = self._step_m(step_m)
        cells = (
            np.count_nonzero(patch.grid.filled) * max(round(patch.grid.pitch_m / step_m), 1) ** 2
            for patch in self.patches
        )
        return sum(cells) + int(self.gaussians.sample_counts(self.voxel_size_m).sum())

    def _step_m(self, step_m: float | None) -> float:
        """Return the spacing of samples, m; the voxel size if omitted."""
        step_m = self.voxel_size_m if step_m is None else as_real('step_m', step_m)
        if not 0.0 < step_m < math.inf:
            raise ValueError(f'step_m: {step_m:g}, expected a positive distance, m')
        return step_m

    def evaluate(self, reference: npt.NDArray[Any], seed: int = 0) -> Evaluation:
        """
        Compare samples of the models with a cloud.

        The expected precision is that of one sample for each point of a Gaussian, as samples that
        stand for several have their weight. Completeness is that of the samples.

        Parameters
        ----------
        reference : (..., 3) float, m
            The cloud as it came from the sensor, not thinned; points that are not finite are left
            out.
        seed : int
            Seed of the samples of Gaussians.

        """
        cloud: Array = np.asarray(reference, np.float64).reshape(-1, 3)
        cloud = cloud[np.isfinite(cloud).all(axis=1)]
        samples, points = self.resample(seed=seed), self.gaussians.num_points
        counts = self.gaussians.sample_counts(self.voxel_size_m)
        weight = np.ones(len(samples))
        weight[len(samples) - counts.sum() :] = np.repeat(points / np.maximum(counts, 1), counts)
        precise, complete = nearest(samples, cloud), nearest(cloud, samples)
        is_near, size_bytes = complete < self.voxel_size_m, self.size_bytes
        return Evaluation(
            precision_rms_m=rms(precise, weight),
            precision_p95_m=p95(precise, weight),
            completeness_rms_m=rms(complete),
            completeness_p95_m=p95(complete),
            coverage=float(np.mean(is_near)) if is_near.size else np.nan,
            num_planes=len(self.planes),
            num_surfaces=len(self.surfaces),
            num_gaussians=len(self.gaussians),
            size_bytes=size_bytes,
            compression=POINT_BYTES * len(cloud) / size_bytes if size_bytes else np.nan,
        )


def evaluate(model: MultiModel, reference: npt.NDArray[Any], seed: int = 0) -> Evaluation:
    """Compare samples of models with a cloud; see MultiModel.evaluate."""
    return model.evaluate(reference, seed)


def read(path: str | Path) -> MultiModel:
    """
    Return the models in a file of ``extract`` or ``replay``, models.smm; they have no labels.

    Raises
    ------
    FileFormatError
        If it cannot be read, is damaged, or of another version.

    """
    try:
        with open_regular(path) as file:
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise FileFormatError(f'{path}: {error.strerror}') from error
    if len(data) > MOST_BYTES:
        raise FileFormatError(f'{path}: larger than {MOST_BYTES} bytes')
    return MultiModel.from_bytes(data, path)
