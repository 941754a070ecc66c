# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Stages that compile all kernels of the package, by running its parts on a small simulated drive.

Images and robots run them when they are built (``surfel-mapper compile``), so that nothing is
compiled later. No list of kernels has to be kept up to date.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from surfel_mapper.compilation import CompileStage
from surfel_mapper.config import Config, ModelsConfig
from surfel_mapper.errors import ConfigError
from surfel_mapper.filters.chain import Chain
from surfel_mapper.filters.registry import all_filters
from surfel_mapper.layers import switches
from surfel_mapper.messages.images import warm_up as warm_up_depth
from surfel_mapper.models import evaluate, fit
from surfel_mapper.offline.options import ReplayOptions
from surfel_mapper.offline.replay import replay
from surfel_mapper.offline.request import Request
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.warm_up import node_stages
from surfel_mapper.simulation import Drive, Lidar, record, Simulation, World
from surfel_mapper.simulation.street import street_pose

SCANS, BEAMS, COLUMNS = 4, 32, 512
"""The drive: enough for a scan to leave the window, and for planes to be found."""


@dataclass(frozen=True, slots=True)
class SmallDrive:
    """
    A simulated drive, and the parts of the package that use it.

    Attributes
    ----------
    directory : Path
        Takes the recording and the outputs.

    """

    directory: Path

    def stages(self) -> list[CompileStage]:
        """Return the stages that compile all kernels."""
        with_window = Config.from_mapping({'window.max_scans': SCANS - 2})
        with_layers = with_window.replace(dict.fromkeys(switches(), True))
        return [
            *node_stages(Mapper(with_window)),
            CompileStage('depth images', warm_up_depth),
            CompileStage('simulation', self.record),
            CompileStage('replay and pictures', partial(self.map, 'mapped', with_window)),
            CompileStage('layers', partial(self.map, 'layers', with_layers)),
            CompileStage('registration', self.register),
            CompileStage('filters', compile_filters),
            CompileStage('models', self.fit),
        ]

    @property
    def simulation(self) -> Simulation:
        """The drive and its lidar."""
        lidar = Lidar(beams=BEAMS, columns=COLUMNS, range_noise_m=0.01)
        return Simulation(
            world=World.street(length_m=40.0),
            lidar=lidar,
            drive=Drive(start=tuple(street_pose())),
            num_scans=SCANS,
        )

    def record(self) -> None:
        """Record the drive."""
        record(self.simulation, self.directory / 'drive')

    def map(self, name: str, config: Config) -> None:
        """Map the drive with the window of a configuration."""
        replay(
            self.directory / 'drive',
            output=self.directory / name,
            config=config,
            options=ReplayOptions(window=True),
        )

    def register(self) -> None:
        """Map the drive without its poses, with times of its points, and align its scans."""
        replay(
            Request(path=self.directory / 'drive', poses_from='registration'),
            output=self.directory / 'registered',
            options=ReplayOptions(align=True),
        )

    def fit(self) -> None:
        """Fit models to a scan of the drive."""
        points = np.ascontiguousarray(self.simulation.scan(0).points)
        points = points[np.isfinite(points).all(axis=1)]
        evaluate(fit(points, ModelsConfig(), np.zeros(3)), points)


def compile_filters() -> None:
    """Compile the kernels of all filters with their defaults, for points of both types."""
    for filter_class in all_filters():
        with contextlib.suppress(ConfigError):  # a parameter without a default
            chain = Chain((filter_class(),))
            for dtype in (np.float32, np.float64):
                chain.warm_up(dtype)
