# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The stage that clears what has moved away."""

from __future__ import annotations

from dataclasses import dataclass

from surfel_mapper.config.settings import setting, Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class DynamicConfig(Stage):
    """Clearing of surfels that later rays go through."""

    clear: bool = setting(False, 'Remove voxels of the surfel map that later scans see through.')
    min_scans: int = setting(
        5,
        'Remove a voxel that so many scans saw through, none of them hitting it in between.',
        low=1,
        high=10**6,
    )
    margin_m: float = setting(
        0.0,
        'A ray goes through a voxel if it ends farther than this behind its centre, m; 0: the '
        'diagonal of a voxel.',
        low=0.0,
        high=1e3,
    )
