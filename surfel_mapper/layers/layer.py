# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Layer: a representation beside the surfels that follows the scans.

The pipeline, the node, a replay, the report and the viewer call these methods of all layers that
are switched on, and name no layer. A layer is below ROS and below the pictures: it publishes
serialised messages with the name of their type, and describes pictures as arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.layers.drawings import Drawing, Section
from surfel_mapper.layers.sensor_models import SensorModels
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import Eviction, SlidingWindow
from surfel_mapper.scan import Scan

Contains = Callable[[npt.NDArray[np.float64]], npt.NDArray[np.bool_]]
"""Returns which of (P, 3) points, map frame, m, are in a region, (P,)."""

NO_VOXELS = np.empty((0, 3), np.int32)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Surroundings:
    """
    The parts of the pipeline that a layer may read.

    Attributes
    ----------
    surfel_map : SurfelMap
        The map; only the pipeline changes it.
    window : SlidingWindow
        The scans that it holds.
    sensors : SensorModels
        The lidar or camera of each frame, shared by all layers.

    """

    surfel_map: SurfelMap
    window: SlidingWindow
    sensors: SensorModels


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class InsertedScan:
    """
    A scan that has just been inserted into the map.

    Attributes
    ----------
    scan : Scan
        Deskewed and filtered, in the frame of its sensor.
    T_map_sensor : (4, 4) float64
        Its pose in the map.
    keys : (K,) int64
        Packed indices of the voxels that hold its points, each once.
    num_points : int
        Points that entered the map.
    evictions : tuple of Eviction
        The scans that left the window because of it.
    cleared : (E, 3) int32
        Voxels that layers cleared after it; none until they are asked.

    """

    scan: Scan
    T_map_sensor: npt.NDArray[np.float64]
    keys: npt.NDArray[np.int64]
    num_points: int
    evictions: tuple[Eviction, ...]
    cleared: npt.NDArray[np.int32] = field(default_factory=lambda: NO_VOXELS)

    def at(self, T_map_sensor: npt.NDArray[np.float64]) -> InsertedScan:
        """Return the scan at another pose, to which an alignment has moved it."""
        return replace(self, T_map_sensor=T_map_sensor)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Moment:
    """
    Stamp, frame and sensor pose of the messages that are published between two scans.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the newest scan; 0 before the first.
    frame_id : str
        Frame of the map.
    T_map_sensor : (4, 4) float64
        Pose of the sensor at that stamp.

    """

    stamp_ns: int = 0
    frame_id: str = ''
    T_map_sensor: npt.NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    @property
    def header(self) -> dict[str, Any]:
        """Stamp and frame, as keyword arguments of functions that write messages."""
        return {'stamp_ns': self.stamp_ns, 'frame_id': self.frame_id}


@dataclass(frozen=True, slots=True, kw_only=True)
class Publication:
    """
    A topic of a layer.

    Attributes
    ----------
    topic : str
        Its name, relative or private: ``~/mesh``.
    type_name : str
        Type of its messages: ``visualization_msgs/msg/Marker``.
    messages : callable
        Takes a Moment; returns the messages, serialised (CDR). Called between two scans.
    depth : int
        Messages that the publisher keeps.
    is_latched : bool
        Transient local rather than volatile.
    rate_hz : callable, optional
        Returns the rate for a configuration, Hz; 0: never. Without it the topic is published
        after every scan for which ``follow`` returned a result, and once more for every new
        subscriber.
    is_eager : bool
        Published without subscribers too, so that later ones find a latched message.
    version : callable, optional
        Takes a Moment; returns a value. A topic with a rate is published only if the value has
        changed.
    prepare : callable, optional
        Does one step of the work for a new subscriber, or for the next messages of a topic with a
        rate; returns True once ``messages`` is fast. Scans are mapped between two steps.
    all_messages : callable, optional
        Replaces ``messages`` for a new subscriber, if ``messages`` returns changes since its last
        call.
    in_background : bool
        The messages are iterated, and thereby made, in another thread than the one that calls
        ``messages`` or ``all_messages``, which must copy all that they need.

    """

    topic: str
    type_name: str
    messages: Callable[[Moment], Iterable[bytes]]
    depth: int = 1
    is_latched: bool = True
    rate_hz: Callable[[Config], float] | None = None
    is_eager: bool = False
    version: Callable[[Moment], object] | None = None
    prepare: Callable[[], bool] | None = None
    all_messages: Callable[[Moment], Iterable[bytes]] | None = None
    in_background: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Images:
    """
    The images that a layer wants joined with scans.

    Attributes
    ----------
    topics : mapping of str to str
        The topic of each kind: ``color``, ``label``.
    tolerance_s : float
        An image belongs to a scan if their stamps differ by at most this.
    setting : str
        Name of the setting of the tolerance, for warnings.

    """

    topics: Mapping[str, str] = field(default_factory=dict)
    tolerance_s: float = 0.0
    setting: str = ''


class Layer:
    """
    Base class of layers, whose methods do nothing unless a layer overrides them.

    Attributes
    ----------
    name : str
        Name of its time per scan, of its summary, and of its result in an Update.
    needs_free_rays : bool
        Whether scans need the directions of rays without a return (``Scan.free``).

    Parameters
    ----------
    config : Config
        All settings.
    around : Surroundings
        Map, window and sensors.

    """

    name: ClassVar[str] = ''
    needs_free_rays: ClassVar[bool] = False

    def __init__(self, config: Config, around: Surroundings) -> None:
        self.config = config
        self.around = around

    @property
    def public(self) -> Any:
        """The object that users get as ``mapper.<name>``; the layer itself by default."""
        return self

    @property
    def images(self) -> Images:
        """The images to join with scans; none by default."""
        return Images()

    def voxels_to_clear(self, inserted: InsertedScan) -> npt.NDArray[np.int32]:
        """
        Return the indices (E, 3) of the voxels to clear after a scan.

        Called before the alignment of the window and before surfels are derived.
        """
        return NO_VOXELS

    def follow(self, inserted: InsertedScan) -> Any:
        """
        Take a scan that was inserted, after the alignment of the window if one was due.

        Returns
        -------
        object or None
            The result, to be found under the layer's name in the Update; None if the layer had
            nothing to do.

        Raises
        ------
        SurfelMapperError
            If the layer cannot take the scan; it is as before then. The failure is counted, and
            a layer that fails several times in a row is switched off.

        """
        return None

    def finish(self) -> None:
        """Process scans that still wait, at the end of a recording."""

    def clear(self) -> None:
        """Forget all scans."""

    def clear_region(self, contains: Contains) -> None:
        """Forget the content of a region; layers that follow the surfels need not."""

    def warm_up(self) -> None:
        """Compile the kernels, for points of every type."""

    def reconfigure(self, config: Config) -> None:
        """Apply new settings; only live ones differ."""
        self.config = config

    def summary(self) -> dict[str, Any]:
        """Return figures for files, reports and diagnostics; empty: no entry."""
        return {}

    def publications(self) -> Sequence[Publication]:
        """Return the topics of the layer; called once."""
        return ()

    @classmethod
    def check_formats(cls, formats: Sequence[str]) -> None:
        """
        Raise DependencyError if a package that formats need is missing; called before mapping.

        Called with formats that the layer is registered with.
        """

    def write(self, directory: Path, formats: Sequence[str]) -> list[Path]:
        """
        Write the layer into a directory that exists, each file whole or not at all.

        Parameters
        ----------
        directory : Path
            Where to.
        formats : sequence of str
            Formats that the user asked for; see the formats of a replay.

        Returns
        -------
        list of Path
            The files.

        Raises
        ------
        FileFormatError
            If a file cannot be written.

        """
        return []

    def save(self, path: Path) -> Callable[[], object] | None:
        """
        Write the state of the layer to a file, whole or not at all.

        Or copy the state and return the function that writes the copy, for another thread: no
        scan is mapped before ``save`` returns. Called only if a layer overrides it; such a layer
        overrides ``load`` too.

        Raises
        ------
        FileFormatError
            If the file cannot be written.

        """
        # not abstract, because a layer without state has none
        raise NotImplementedError(f'{type(self).__name__}: implement save')

    def load(self, path: Path) -> Callable[[], None]:
        """
        Read a state that ``save`` wrote; return the function that puts it in place.

        Called only if a layer overrides it, as for ``save``.

        Raises
        ------
        FileFormatError
            If the file cannot be read, is damaged or was written with other settings; the layer
            is as before then.

        """
        # not abstract, because a layer without state has none
        raise NotImplementedError(f'{type(self).__name__}: implement load, as it has save')

    def drawings(self) -> Sequence[Drawing]:
        """Return the layer as shapes in the map, for the viewer and the report."""
        return ()

    def section(self) -> Section | None:
        """Return a section for the report."""
        return None
