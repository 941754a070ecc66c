# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LiveViewer: the page on which a node shows its map, ``viewer.enabled``.

The mapping thread only copies what is shown, at ``rate_hz`` and if the last copy has been
sent; triangles are made and sent in a thread of its own, so that mapping does not wait for it.
"""

from __future__ import annotations

from contextlib import suppress
import logging
import queue
import threading
import time
from typing import TYPE_CHECKING

from surfel_mapper.viz.scene import Scene
from surfel_mapper.viz.server import LIVE
from surfel_mapper.viz.viewer import Snapshot, Viewer, WHOLE_S

if TYPE_CHECKING:
    from surfel_mapper.pipeline import Mapper, Update

log = logging.getLogger(__name__)


class LiveViewer:
    """
    Shows the map of a node on a page.

    Parameters
    ----------
    mapper : Mapper
        The mapper of the node, whose settings ``viewer.*`` are used.

    Raises
    ------
    DependencyError
        If rerun is not installed.
    SurfelMapperError
        If the page cannot be served.

    """

    def __init__(self, mapper: Mapper) -> None:
        settings = mapper.config.viewer
        self._scene = Scene.to_browser(settings.port, LIVE)
        self._viewer = Viewer(mapper, self._scene, settings.color)
        self._period_s = 1.0 / settings.rate_hz
        self._due_s = self._whole_due_s = 0.0
        self._shots: queue.Queue[Snapshot | None] = queue.Queue(1)
        self._thread = threading.Thread(target=self._run, name='viewer', daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """Address of the page."""
        return self._scene.address

    def add(self, update: Update) -> None:
        """Show a scan if it is time; called in the mapping thread."""
        self._viewer.note(update)
        now_s = time.monotonic()
        if now_s < self._due_s or self._shots.full() or not self._thread.is_alive():
            return
        self._due_s = now_s + self._period_s
        shot = self._viewer.snapshot(update, whole=now_s > self._whole_due_s)
        if shot.surfels is not None:
            self._whole_due_s = now_s + WHOLE_S
        self._shots.put(shot)

    def close(self) -> None:
        """End the page; called when the mapping thread has ended."""
        while self._thread.is_alive():
            with suppress(queue.Full):  # it is still at work on another
                self._shots.put(None, timeout=0.1)
                self._thread.join()
        self._scene.__exit__()

    def _run(self) -> None:
        """Show snapshots; an error ends the viewer and not the node."""
        try:
            while (shot := self._shots.get()) is not None:
                self._viewer.show(shot)
        except Exception as error:  # rerun raises errors of many types
            log.warning('the viewer has failed, the node goes on without it: %s', error)
