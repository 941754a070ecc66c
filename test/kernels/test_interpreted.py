# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A map made without the compiler, in a process of its own, equals one made with it."""

from test.kernels.modes import printed_alike

SHORT_MAPPING = """
import hashlib
import numpy as np
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.mapping.ages import last_seen_ns
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import WindowedScan

rng = np.random.default_rng(1)
surfel_map, live = SurfelMap(0.2), []
for number in range(6):
    points = rng.normal(scale=[3.0, 3.0, 0.3], size=(250, 3))
    points = points.astype([np.float32, np.float64][number % 2])
    points[::50] = np.nan
    points[1::60] = 1e20
    q = rng.normal(size=4)
    pose = pose_matrix([9000.0 + number, -4.0, 1.0], q / np.linalg.norm(q))
    live.append(surfel_map.reduce(points, pose, origin=pose[:3, 3], max_range_m=9.0))
    surfel_map.insert(live[-1])
    print(live[-1].left_out, surfel_map.digest())
    if number % 2:
        print(len(surfel_map.remove(live.pop(0), 2)))
    surfels = surfel_map.surfels_changed()
    order = np.lexsort(surfels.voxel_index.T)
    bits = b''.join(getattr(surfels, name)[order].tobytes() for name in (
        'position', 'normal', 'planarity', 'curvature', 'eigenvalues', 'num_points'))
    print(len(surfels), hashlib.sha256(bits).hexdigest())
coarse = surfel_map.coarsen(2, within=(np.array([44950, -35, -5]), np.array([45050, 5, 12])))
index = coarse.index(2)
points = index.surfels.position + rng.normal(size=(len(index.surfels), 3))
print(coarse.digest(), index.at(points).tolist(), index.nearest(points, 0.7)[0].tolist())
print(len(surfel_map.surfels_changed(since=surfel_map.version - 3)))
window = [WindowedScan(moments=each, stamp_ns=n, T_map_sensor=pose) for n, each in enumerate(live)]
few = surfel_map.surfels(1, at_most=100).voxel_index
for scans in (window, window[1:]):
    print(np.bincount(last_seen_ns(few, scans) + 1))
try:
    surfel_map.remove(live[0])
    surfel_map.remove(live[0])
except ValueError as error:
    print(error)
"""


def test_a_map_is_the_same_to_the_bit_without_the_compiler():
    text = printed_alike(SHORT_MAPPING)
    assert 'does not hold' in text
    assert len(text.splitlines()) == 20
