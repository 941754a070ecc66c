# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of LUM makes the stated graphs; times are not tested."""

from __future__ import annotations

import numpy as np

from surfel_mapper.alignment import LUM
from test.bench.lum import Case, chain, ours, points


def test_a_case_is_timed_and_aligned():
    case = Case('small', 5, chain(5, (1, 2), 7), 30, 4)
    clouds = points(case)

    times = ours(case, clouds)  # in such a small case the time of an iteration is noise
    assert all(compute_ms > 0.0 for compute_ms, _ in times)

    lum = LUM(max_iterations=case.iterations)
    for cloud in clouds:
        lum.add_point_cloud(cloud)
    pairs = np.repeat(np.arange(case.pairs)[:, None], 2, axis=1)
    for ends in case.ends:
        lum.set_correspondences(*ends, pairs)
    assert max(lum.compute().residuals.values()) < 0.1
