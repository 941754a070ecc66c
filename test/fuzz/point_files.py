# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The harness of files that ``view`` shows."""

from __future__ import annotations

from surfel_mapper.viz.contents import contents
from test.fuzz.files import refused

SHOWN = ('.obj', '.stl', '.glb')


def shown(data: bytes) -> None:
    """Read a file that ``view`` shows; the first byte selects its kind."""
    suffix = SHOWN[data[0] % len(SHOWN) if data else 0]
    refused(lambda path: [*contents(path)], f'input{suffix}', data[1:])
