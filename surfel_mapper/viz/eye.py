# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Eye: the full detail of a map follows the place that the window of rerun looks at.

Rerun keeps the eye of a 3D view in its blueprint, with each motion of the mouse, and a client can
read the blueprint of a window (0.41; the client is experimental there). A page in a browser has no
such service, so its detail stays around ``--at``.
"""

from __future__ import annotations

import logging
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.viz.scene import Scene
from surfel_mapper.viz.show import Shown

EVERY_S = 0.5
"""Time between two looks at the eye, s; a blueprint of a window is some kilobytes."""

STARTING_S = 30.0
"""Longest wait for the first answer of a window, s."""

logger = logging.getLogger(__name__)


def followed(scene: Scene, shown: Shown) -> None:
    """
    Give the place looked at the full detail, until the window closes.

    Returns at once, with a sentence in the log, if this version of rerun cannot be asked.
    """
    try:
        from rerun.experimental import ViewerClient

        ask = ViewerClient.connect(scene.window).get_blueprint
    except (ImportError, AttributeError):
        logger.warning('this rerun reports no camera position (0.41 does): the detail stays fixed')
        return
    previous: npt.NDArray[np.float64] | None = None
    deadline = time.monotonic() + STARTING_S
    while True:
        try:
            looked_at = target(ask().blueprint)
        except (ConnectionError, RuntimeError, TimeoutError) as error:
            if previous is None and time.monotonic() < deadline:
                time.sleep(EVERY_S)
                continue
            logger.info('the window has closed: %s', error)
            return
        if looked_at is not None and (previous is None or (looked_at != previous).any()):
            shown.look(scene, looked_at)
            previous = looked_at
        time.sleep(EVERY_S)


def target(blueprint: dict[str, Any]) -> npt.NDArray[np.float64] | None:
    """Return the place that the first 3D view of a blueprint looks at, (3,) m; None without."""
    for path, archetypes in blueprint.items():
        look_target = archetypes.get('EyeControls3D', {}).get('look_target')
        if path.endswith('/EyeControls3D') and look_target is not None:
            return np.asarray(look_target, np.float64)
    return None
