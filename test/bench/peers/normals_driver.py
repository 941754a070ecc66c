# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Has one peer estimate normals; runs in the environment of the peer.

Arguments: the module of the peer, the file of the points, that of the normals, the support.
"""

from __future__ import annotations

from importlib import import_module
import sys

import numpy as np


def main() -> None:
    """Do the job."""
    module, points, normals, support = sys.argv[1:]
    np.save(normals, import_module(module).normals(np.load(points), int(support)))


if __name__ == '__main__':
    main()
