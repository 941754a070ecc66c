# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The stage of alignment: when the scans of the window are moved until they agree, and how."""

from __future__ import annotations

from dataclasses import dataclass

from surfel_mapper.config.settings import setting, Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignConfig(Stage):
    """Consistent poses for the scans of the window."""

    every_scans: int = setting(
        0,
        'Align the scans of the window whenever so many more are mapped; needs '
        'window.keep_points. 0: only when asked to.',
        low=0,
        high=2**31 - 1,
        live=True,
    )
    voxel_size_m: float = setting(
        1.0, 'Edge of the surfels of a scan that are matched, m.', low=0.01, high=100.0
    )
    key_distance_m: float = setting(
        1.0,
        'Scans so far apart on the way are aligned, those between go along with them, m; '
        '0: every scan is aligned.',
        low=0.0,
        high=1e6,
        live=True,
    )
    max_distance_m: float = setting(
        1.0, 'Surfels farther apart do not belong together, m.', low=1e-3, high=1e3, live=True
    )
    max_angle_deg: float = setting(
        30.0, 'Nor do those whose normals differ by more, deg.', low=1.0, high=180.0, live=True
    )
    min_overlap: float = setting(
        0.2,
        'Scans are compared if at least this share of the surfels of one belongs to the other.',
        low=0.0,
        high=1.0,
        live=True,
    )
    loop_distance_m: float = setting(
        10.0,
        'Scans so near to each other are compared however long the way between them was, m; '
        '0: none are.',
        low=0.0,
        high=1e6,
        live=True,
    )
    max_rounds: int = setting(
        20, 'Surfels are matched anew at most so often.', low=1, high=1000, live=True
    )
    settled_m: float = setting(
        0.002, 'Poses have settled when none changes by more, m.', low=1e-6, high=1.0, live=True
    )
    settled_deg: float = setting(0.01, 'Nor turns by more, deg.', low=1e-6, high=10.0, live=True)
    move_m: float = setting(
        0.002, 'Scans that go farther are moved in the map, m.', low=0.0, high=1e3, live=True
    )
    move_deg: float = setting(
        0.01, 'So are those that turn by more, deg.', low=0.0, high=180.0, live=True
    )
    map_frame: str = setting(
        '',
        'Frame of the map once alignment moves scans: its transform to frames.fixed is '
        'published; empty: the map keeps the name of frames.fixed, and there is no transform.',
    )
