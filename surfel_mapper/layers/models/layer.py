# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The models of a map as a layer: planes, B-spline surfaces and Gaussians that follow the map.

They follow by the stamps of the scans, never by the clock, so that a bag replayed at any speed
gives the same updates. A voxel that changed several times between two updates is processed once,
so a longer period costs less.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.errors import counted
from surfel_mapper.files.model_files import PACKED, TRIANGLES, write_models, write_packed
from surfel_mapper.files.triangles import import_trimesh
from surfel_mapper.layers.drawings import Drawing, Section
from surfel_mapper.layers.layer import InsertedScan, Layer, Moment, Publication, Surroundings
from surfel_mapper.layers.models.pictures import drawings_of, picture_of, section_of
from surfel_mapper.messages.markers import marker_array, polygon_instance
from surfel_mapper.messages.model_messages import (
    model_markers,
    primitive_columns,
    surfel_primitive_columns,
)
from surfel_mapper.messages.model_packets import COMPLETE_EVERY, ModelStream
from surfel_mapper.messages.pointcloud2 import cloud_bytes, from_columns
from surfel_mapper.models.fitting import above, surfel_points
from surfel_mapper.models.live import LiveModels, ModelUpdate
from surfel_mapper.models.outlines import bridged
from surfel_mapper.models.shapes import PatchShape, Shapes

STEP = 50
"""Shapes made between two scans for a new subscriber, which takes some 15 ms."""

OUTLINES_KEPT = 1000
"""Depth of ~/outlines: there is a message for each polygon, and there may be hundreds at once."""


class ModelsLayer(Layer):
    """
    Live models of the map.

    Attributes
    ----------
    models : LiveModels
        The models; ``mapper.models``.

    """

    name = 'models'

    def __init__(self, config: Config, around: Surroundings) -> None:
        super().__init__(config, around)
        self.models = LiveModels(config.models, around.surfel_map)
        self._last_ns: int | None = None
        self._shapes = Shapes()
        self._stream = ModelStream()
        self._published: dict[int, int] = {}
        """Versions of the outlines that were published, by id."""

    @property
    def public(self) -> LiveModels:
        """The models themselves."""
        return self.models

    def clear(self) -> None:
        """Forget the models and the time of their last update."""
        self.models.clear()
        self._last_ns = None

    def follow(self, inserted: InsertedScan) -> ModelUpdate | None:
        """Update the models if ``layers.models.extract_period_s`` has passed since the last."""
        stamp_ns = inserted.scan.stamp_ns
        period_ns = round(self.config.models.extract_period_s * 1e9)
        if self._last_ns is not None and abs(stamp_ns - self._last_ns) < period_ns:
            return None
        self._last_ns = stamp_ns
        return self.models.update()

    def finish(self) -> None:
        """Update the models to the present map, alignments included."""
        self.models.update()

    def warm_up(self) -> None:
        """Compile the kernels."""
        self.models.warm_up()

    def summary(self) -> dict[str, Any]:
        """Return the numbers of models and their size."""
        return self.models.summary()

    def publications(self) -> Sequence[Publication]:
        """Return the models, and their markers, tables and outlines."""
        return (
            Publication(
                topic='~/models',
                type_name='std_msgs/msg/UInt8MultiArray',
                messages=self._changed_models,
                all_messages=self._all_models,
                depth=COMPLETE_EVERY,
            ),
            Publication(
                topic='~/planes',
                type_name='visualization_msgs/msg/MarkerArray',
                messages=self._marker_messages,
                prepare=self._make_shapes,
            ),
            Publication(
                topic='~/primitives',
                type_name='sensor_msgs/msg/PointCloud2',
                messages=self._primitive_messages,
                prepare=self._make_shapes,
            ),
            Publication(
                topic='~/surfel_primitives',
                type_name='sensor_msgs/msg/PointCloud2',
                messages=self._surfel_messages,
            ),
            Publication(
                topic='~/outlines',
                type_name='geometry_msgs/msg/PolygonInstanceStamped',
                messages=self._changed_outlines,
                all_messages=self._all_outlines,
                prepare=self._make_shapes,
                depth=OUTLINES_KEPT,
            ),
        )

    @classmethod
    def check_formats(cls, formats: Sequence[str]) -> None:
        """Raise DependencyError if trimesh is needed and not installed."""
        if not {*TRIANGLES}.isdisjoint(formats):
            import_trimesh()

    def write(self, directory: Path, formats: Sequence[str]) -> list[Path]:
        """Write models.smm and models.json, and Parquet, OBJ and GLB if asked for."""
        wanted = ['json', *(name for name in ('parquet', *TRIANGLES) if name in formats)]
        model, versions = self.models.model, self.models.versions
        model = model.translated(self.around.surfel_map.origin_m)
        packed = write_packed(directory / PACKED, model, versions)
        return [packed, *write_models(directory, model, wanted, versions)]

    def drawings(self) -> Sequence[Drawing]:
        """Return patches and their outlines, and Gaussians as ellipsoids."""
        return drawings_of(self._current_shapes(), self.models.model.gaussians)

    def section(self) -> Section:
        """Return figures, a picture, and a table of the largest patches."""
        model, surfels = self.models.model, self.models.surfels
        points = surfel_points(surfels, model.voxel_size_m)
        picture = picture_of(points, model, above(surfels), counted(len(surfels), 'voxel'))
        return section_of(model, self._current_shapes(), picture)

    def _make_shapes(self) -> bool:
        """Make some of the missing shapes; return whether none is missing."""
        return self._shapes.make(self.models.model, self.models.versions, STEP)

    def _current_shapes(self) -> list[PatchShape]:
        return self._shapes.of(self.models.model, self.models.versions)

    def _changed_models(self, moment: Moment) -> list[bytes]:
        message = self._stream.changes(self.models.model, self.models.versions, **moment.header)
        return [] if message is None else [message]

    def _all_models(self, moment: Moment) -> list[bytes]:
        return [self._stream.complete(self.models.model, self.models.versions, **moment.header)]

    def _marker_messages(self, moment: Moment) -> list[bytes]:
        markers = model_markers(
            self._current_shapes(),
            self.models.model.gaussians,
            self.around.surfel_map.voxel_size_m,
            **moment.header,
        )
        return [marker_array(markers)]

    def _primitive_messages(self, moment: Moment) -> list[bytes]:
        gaussians, versions = self.models.model.gaussians, self.models.versions
        columns = primitive_columns(self._current_shapes(), gaussians, versions)
        return [cloud_bytes(from_columns(columns), **moment.header)]

    def _surfel_messages(self, moment: Moment) -> list[bytes]:
        columns = surfel_primitive_columns(self.models.surfels, self.models.model)
        return [cloud_bytes(from_columns(columns), **moment.header)]

    def _all_outlines(self, moment: Moment) -> Iterable[bytes]:
        self._published = dict.fromkeys(self._published, 0)  # and removed ones, empty
        return self._changed_outlines(moment)

    def _changed_outlines(self, moment: Moment) -> Iterable[bytes]:
        """Yield outlines that have changed, and empty ones of patches that were removed."""
        shapes = {shape.patch.id: shape for shape in self._current_shapes()}
        versions = {number: self.models.versions[number] for number in shapes}
        previous, self._published = self._published, versions
        rings: dict[int, npt.NDArray[np.float64]] = {}
        rings |= {number: np.empty((0, 3)) for number in previous.keys() - shapes.keys()}
        rings |= {
            number: bridged(shapes[number].rings)
            for number, version in versions.items()
            if previous.get(number) != version
        }
        for number, ring in rings.items():
            yield polygon_instance(ring, number, **moment.header)
