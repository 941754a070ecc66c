# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Offsets between the clocks of sensors and of poses, by the record times of a bag."""

from __future__ import annotations

from collections.abc import Collection

from surfel_mapper.offline.survey import of_namespace, Survey
from surfel_mapper.poses import ClockOffset, offset_s


def clock_offsets(
    sample: Survey, topics: Collection[str], poses: Collection[str] | None = None
) -> list[ClockOffset]:
    """
    Return the offsets of the clocks of clouds from that of the first poses that show one.

    Parameters
    ----------
    sample : Survey
        Of a bag, or of its beginning.
    topics : collection of str
        Topics of clouds.
    poses : collection of str, optional
        Topics of poses; by default all in the namespace of the clouds, else the first clouds.

    """
    offsets = []
    for clouds in topics:
        names = [source.topic for source in of_namespace(sample.sources, clouds)]
        names = [
            name for name in names if name in sample.leads_ns and (poses is None or name in poses)
        ]
        for name in names or [name for name in topics if name != clouds][:1]:
            seconds = offset_s(sample.leads_ns.get(clouds, []), sample.leads_ns.get(name, []))
            if seconds is not None:
                offsets.append(ClockOffset(clouds, name, seconds))
                break
    return offsets
