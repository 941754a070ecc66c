# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Changes from one map to another: new surfels, lost surfels, turned surfels.

    surfel-mapper replay monday/ --output monday_map/
    surfel-mapper replay tuesday/ --output tuesday_map/
    python examples/compare_maps.py monday_map/map.npz tuesday_map/map.npz --output changes.ply

Both maps have to be in one frame and of one voxel size. Equal digests show that they are equal
to the bit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from surfel_mapper import Surfels
from surfel_mapper.files.map_state import load_map
from surfel_mapper.files.ply import write_surfels
from surfel_mapper.mapping.moments import pack_keys


def main() -> None:
    """Compare two maps, voxel by voxel."""
    parser = argparse.ArgumentParser(description=str(__doc__).strip().partition('\n')[0])
    parser.add_argument('before', type=Path, help='map.npz of a replay, or of ~/save_map')
    parser.add_argument('after', type=Path, help='map.npz of the later map')
    parser.add_argument(
        '--min-points', type=int, default=20, help='points that a surfel needs (%(default)s)'
    )
    parser.add_argument(
        '--angle',
        type=float,
        default=30.0,
        metavar='DEG',
        help='angle that counts as a turn (%(default)s)',
    )
    parser.add_argument(
        '--output', type=Path, help='write new and turned surfels to this PLY file'
    )
    args = parser.parse_args()

    first, _ = load_map(args.before)
    second, _ = load_map(args.after, voxel_size_m=first.voxel_size_m)
    if first.digest() == second.digest():
        print(f'equal to the bit: {first.digest()}')
        return
    before, after = (it.surfels(min_points=args.min_points) for it in (first, second))
    old, new = pack_keys(before.voxel_index), pack_keys(after.voxel_index)
    _, i, j = np.intersect1d(old, new, return_indices=True)
    cosine = np.abs(np.einsum('ij,ij->i', before.normal[i], after.normal[j]))
    is_flat = np.minimum(before.planarity[i], after.planarity[j]) > 0.5
    turned = j[is_flat & (cosine < np.cos(np.deg2rad(args.angle)))]
    came = np.flatnonzero(~np.isin(new, old))
    print(
        f'{len(before)} surfels before, {len(after)} after, {len(i)} in the same voxels\n'
        f'{len(came)} came, {len(before) - len(i)} went, '
        f'{len(turned)} turned by more than {args.angle:g} deg'
    )
    if args.output:
        write(after, np.concatenate([came, turned]), args.output)


def write(surfels: Surfels, rows: np.ndarray, path: Path) -> None:
    """Write some surfels."""
    write_surfels(path, surfels.select(rows))
    print(path)


if __name__ == '__main__':
    main()
