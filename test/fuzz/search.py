# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Searches with atheris, each in a process of its own: ``test.fuzz`` starts these.

The readers are instrumented as they are imported, so that the search sees which branches an
input takes; the kernels are not, since numba compiles them.
"""

from __future__ import annotations

import importlib
import logging
from pathlib import Path
import pkgutil
import sys
import tempfile

import atheris

import surfel_mapper
from test.fuzz.children import each

MOST_MB = 2048
SLOWEST_S = 60
"""Time after which an input counts as a hang, s; far above any valid one on a busy machine."""


def main(folder: str, seconds: str, *names: str) -> None:
    """Search with the harnesses of names, from the corpora in ``folder/NAME`` on."""
    for module in pkgutil.walk_packages(surfel_mapper.__path__, 'surfel_mapper.'):
        if '.kernels.' in module.name:
            importlib.import_module(module.name)
    with atheris.instrument_imports(
        include=['surfel_mapper', 'rosbags.rosbag1', 'rosbags.rosbag2'],
        enable_loader_override=False,
    ):
        from test.fuzz.harnesses import HARNESSES
    logging.disable(logging.CRITICAL)
    findings = tempfile.gettempdir()

    def search(name: str) -> None:
        harness = HARNESSES[name]
        for seed in harness.corpus():
            harness.one_input(seed)  # kernels that compile are no hang
        arguments = [
            'atheris',
            str(Path(folder, name)),
            f'-max_total_time={round(float(seconds))}',
            f'-timeout={SLOWEST_S}',
            f'-rss_limit_mb={MOST_MB}',
            '-max_len=65536',
            f'-artifact_prefix={findings}/{name}-',
        ]
        atheris.Setup(arguments, harness.one_input)
        atheris.Fuzz()

    each(list(names), search, Path(folder), 'search')


if __name__ == '__main__':
    main(*sys.argv[1:])
