# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Estimate normals with one peer; runs in the environment of the peer.

Arguments: the module of the peer, the file of the points, the file for the normals, the support.
"""

from __future__ import annotations

from importlib import import_module
import sys

import numpy as np


def main() -> None:
    """Run the job."""
    module, points, normals, support = sys.argv[1:]
    np.save(normals, import_module(module).normals(np.load(points), int(support)))


if __name__ == '__main__':
    main()
