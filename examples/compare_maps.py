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

from surfel_mapper import diff, SurfelMap
from surfel_mapper.files.ply import write_surfels
from surfel_mapper.mapping.surfels import concatenated


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

    before, after = SurfelMap.load(args.before), SurfelMap.load(args.after)
    found = diff(before, after, min_points=args.min_points, angle_deg=args.angle)
    if found.equal:
        print(f'equal to the bit: {after.digest()}')
        return
    print(found)
    if args.output:
        write_surfels(args.output, concatenated([found.came, found.turned]), after.origin_m)
        print(args.output)


if __name__ == '__main__':
    main()
