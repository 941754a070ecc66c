# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A map inline in a notebook: the 3D view of the report in a frame, without a server."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_numbers
from surfel_mapper.errors import counted
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.viz.detail import drawn_surfels
from surfel_mapper.viz.report import page
from surfel_mapper.viz.turning_view import most_shown, turning_view


class InlineView:
    """
    An interactive 3D view of a map, which Jupyter shows as the result of a cell.

    Parameters
    ----------
    content : str
        A whole page of HTML, whose policy forbids all requests.
    about : str
        Text shown in place of the view where there is no HTML.

    """

    def __init__(self, content: str, about: str) -> None:
        self.content = content
        self._about = about

    def __repr__(self) -> str:
        """Return what is shown."""
        return f'InlineView({self._about})'

    def _repr_html_(self) -> str:
        """Return the view as a frame."""
        return (
            f'<iframe srcdoc="{escape(self.content)}" width="100%" height="640" '
            'style="border: 0" title="surfel map" allowfullscreen></iframe>'
        )


def show(
    shown: SurfelMap | Surfels, *, min_points: int = 5, place: npt.ArrayLike | None = None
) -> InlineView:
    """
    Return an interactive 3D view for a notebook, of at most 50,000 surfels (1.7 MB).

    Parameters
    ----------
    shown : SurfelMap or Surfels
        A map with more surfels is shown by larger voxels far from ``place``.
    min_points : int
        Voxels of a map with fewer points are not shown.
    place : (3,) float, m, optional
        Place with full detail, in the frame of the map; by default the median of the surfels.

    Raises
    ------
    TypeError
        If it is neither a map nor surfels.

    Examples
    --------
    >>> import numpy as np
    >>> from surfel_mapper import SurfelMap
    >>> surfel_map = SurfelMap(0.5)
    >>> _ = surfel_map.add(np.random.default_rng(0).uniform(0, [2, 2, 0.1], (1000, 3)))
    >>> show(surfel_map)  # the last line of a cell of a notebook
    InlineView(16 surfels)

    """
    if not isinstance(shown, (SurfelMap, Surfels)):
        raise TypeError(
            f'a {type(shown).__name__}, expected a SurfelMap or Surfels; points are added to a '
            'map by SurfelMap.add'
        )
    summary: dict[str, Any] = {}
    if isinstance(shown, SurfelMap):
        summary['origin_m'] = shown.origin_m.tolist()
        surfels = shown.surfels(min_points)
        if place is None and len(surfels):
            place = np.median(surfels.position, axis=0)
        near = np.zeros(3) if place is None else as_numbers('place', place)
        if near.shape != (3,) or not np.isfinite(near).all():
            raise ValueError(f'place: {place!r}, expected x y z, m, finite')
        adaptive = shown.adaptive(min_points)
        drawn = drawn_surfels(adaptive, shown, min_points, near, most_shown({}))
    else:
        surfels = drawn = shown
    summary['surfels'] = len(surfels)
    valid = drawn.select(np.isfinite(drawn.planarity))
    body = turning_view(valid, np.empty((0, 3)), np.empty(0), summary, {})
    return InlineView(page('map', body), counted(len(surfels), 'surfel'))
