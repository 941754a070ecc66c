# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
One search with atheris, in a process that ends with it: ``test.fuzz`` starts these.

The readers are instrumented as they are imported, so that the search sees which branches an
input takes; the kernels are not, since numba compiles them.
"""

from __future__ import annotations

import importlib
import logging
import pkgutil
import sys
import tempfile

import atheris

import surfel_mapper

MOST_MB = 2048
SLOWEST_S = 60
"""Time after which an input counts as a hang, s; far above any valid one on a busy machine."""


def main(name: str, corpus: str, seconds: str) -> None:
    """Search from a corpus on with the harness of a name."""
    for module in pkgutil.walk_packages(surfel_mapper.__path__, 'surfel_mapper.'):
        if '.kernels.' in module.name:
            importlib.import_module(module.name)
    with atheris.instrument_imports(
        include=['surfel_mapper', 'rosbags.rosbag1', 'rosbags.rosbag2'],
        enable_loader_override=False,
    ):
        from test.fuzz.harnesses import HARNESSES
    logging.disable(logging.CRITICAL)
    harness = HARNESSES[name]
    for seed in harness.corpus():
        harness.one_input(seed)  # kernels that compile are no hang
    arguments = [
        sys.argv[0],
        corpus,
        f'-max_total_time={seconds}',
        f'-timeout={SLOWEST_S}',
        f'-rss_limit_mb={MOST_MB}',
        '-max_len=65536',
        f'-artifact_prefix={tempfile.gettempdir()}/{name}-',
    ]
    atheris.Setup(arguments, harness.one_input)
    atheris.Fuzz()


if __name__ == '__main__':
    main(*sys.argv[1:])
