# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Search for inputs that cost too much, each in a process of its own: ``test.fuzz`` starts these.

Not instrumented, so that the times are those of users. Inputs are seeds, those that atheris found,
and mutations of both; one in some is enlarged to megabytes, because a reader that takes too long
for each line is not seen in small files. Prints a line of JSON.
"""

from __future__ import annotations

from collections.abc import Iterator
import itertools
import json
import logging
from pathlib import Path
import sys
import tempfile
import time
import warnings

import numpy as np

from test.fuzz.children import each
from test.fuzz.harnesses import HARNESSES
from test.fuzz.mutations import enlarged, mutations
from test.fuzz.oracle import checked_cost, Cost

BATCH = 1000
"""Mutations of a seed of the random numbers."""

LARGE_ONE_IN = 50
"""Number of mutations of which the last is enlarged, too."""


def main(folder: str, seconds: str, *names: str) -> None:
    """Measure inputs of the harnesses of names, from the corpora in ``folder/NAME`` on."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter('ignore')
    np.seterr(all='ignore')
    findings = tempfile.gettempdir()

    def measure(name: str) -> None:
        inputs = [path.read_bytes() for path in sorted(Path(folder, name).iterdir())]
        one_input = HARNESSES[name].one_input
        one_input(inputs[0])  # imports and compiled kernels are not counted
        worst, number, end_s = Cost(0, 0.0, 0.0, 0.0), 0, time.monotonic() + float(seconds)
        for data in endless(inputs, int(end_s)):
            try:
                found = checked_cost(name, one_input, data)
            except BaseException:
                path = Path(findings, f'{name}-expensive-{int(end_s)}')
                path.write_bytes(data)
                print(f'{name}: {path}', file=sys.stderr)
                raise
            worst = Cost(*map(max, worst, found))
            number += 1
            if time.monotonic() > end_s:
                break
        print(json.dumps({'inputs': number, **worst._asdict()}))

    each(list(names), measure, Path(folder), 'measure')


def endless(inputs: list[bytes], seed: int) -> Iterator[bytes]:
    """Yield inputs, then mutations of them without end."""
    yield from inputs
    while True:
        seed += 1
        mutated = itertools.islice(mutations(inputs, BATCH, seed), len(inputs), None)
        for number, data in enumerate(mutated, start=1):
            yield data
            if number % LARGE_ONE_IN == 0:
                yield enlarged(data, seed + number)


if __name__ == '__main__':
    main(*sys.argv[1:])
