# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Search for inputs that cost too much, in a process that ends with it: ``test.fuzz`` starts these.

Not instrumented, so that the times are those of users. Inputs are seeds, those that atheris found,
and mutations of both. Prints a line of JSON.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path
import sys
import tempfile
import time
import warnings

import numpy as np

from test.fuzz.harnesses import HARNESSES
from test.fuzz.mutations import mutations
from test.fuzz.oracle import checked_cost, Cost

BATCH = 1000
"""Mutations of a seed of the random numbers."""


def main(name: str, corpus: str, seconds: str) -> int:
    """Measure inputs for a time; return 1 if one costs too much, or raises."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter('ignore')
    np.seterr(all='ignore')
    inputs = [path.read_bytes() for path in sorted(Path(corpus).iterdir())]
    one_input = HARNESSES[name].one_input
    one_input(inputs[0])  # imports and compiled kernels are not counted
    worst, number, end_s = Cost(0, 0.0, 0.0, 0.0), 0, time.monotonic() + float(seconds)
    seed = int(end_s)
    while time.monotonic() < end_s:
        seed += 1
        for data in mutations(inputs, BATCH, seed) if number else inputs:
            try:
                found = checked_cost(name, one_input, data)
            except Exception:
                path = Path(tempfile.gettempdir(), f'{name}-expensive-{seed}')
                path.write_bytes(data)
                print(f'{name}: {path}', file=sys.stderr)
                raise
            worst = Cost(*map(max, worst, found))
            number += 1
            if time.monotonic() > end_s:
                break
    print(json.dumps({'name': name, 'inputs': number, **worst._asdict()}))
    return 0


if __name__ == '__main__':
    sys.exit(main(*sys.argv[1:]))
