# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Search for inputs that break a harness: ``python -m test.fuzz [NAME ...] --seconds 600``.

Without names, a share of the failures of test_failures.py comes first; the searches have the rest
of the time, half of it atheris, which looks for exceptions that are not ours, 2 GB and hangs. Then
inputs are measured without instruments: the seeds, what atheris found, and mutations of both, by
the limits of oracle.py: 64 MiB and 20 bytes a byte, 0.2 s and 100 ns a byte. Each harness has a
process of its own, and ends at its first finding, in a file whose name is printed;
``--input FILE`` tries it again. The last lines are a table of the worst costs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.util import find_spec
import json
import os
from pathlib import Path
import random
import re
import subprocess
import sys
import tempfile
import time

from surfel_mapper.cli._arguments import positive_int
from test.fuzz.harnesses import HARNESSES
from test.fuzz.test_failures import SHARES

HEAD = (
    '| input | atheris | measured | most MiB | most bytes per byte above 64 MiB | most ms |',
    '|---|---|---|---|---|---|',
)

START_S = 5.0
"""Time that a process takes to import, or to load kernels, by harness, s."""

LEAST_S = 2.0
"""Time of a search, s, however few seconds are left."""


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    result = argparse.ArgumentParser(prog='python -m test.fuzz', description='Search for crashes.')
    result.add_argument('names', nargs='*', metavar='NAME', help=f'of {", ".join(HARNESSES)}')
    result.add_argument(
        '--seconds', type=positive_int, default=600, help='of all; default: %(default)s'
    )
    result.add_argument('--input', type=Path, metavar='FILE', help='try one input')
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the number of harnesses that broke, and failed tests."""
    end_s = time.monotonic()
    args = parser().parse_args(arguments)
    end_s += args.seconds
    names = args.names or list(HARNESSES)
    unknown = sorted({*names} - {*HARNESSES})
    if unknown:
        print(f'{", ".join(unknown)}: no such harness; there are {", ".join(HARNESSES)}')
        return 2
    if args.input:
        for name in names:
            HARNESSES[name].one_input(args.input.read_bytes())
        return 0
    if find_spec('atheris') is None:
        print("atheris is not installed: pip install -e '.[fuzz]'", file=sys.stderr)
        return 2
    broken = 0 if args.names else failures()
    with tempfile.TemporaryDirectory(prefix='surfel_mapper-corpus-') as folder:
        for name in names:
            Path(folder, name).mkdir()
            for number, data in enumerate(HARNESSES[name].corpus()):
                Path(folder, name, str(number)).write_bytes(data)
        in_processes('search', names, folder, (end_s - time.monotonic()) / 2.0)
        in_processes('measure', names, folder, end_s - time.monotonic())
        rows = [row(name, Path(folder)) for name in names]
    print('\n'.join([*HEAD, *(text for text, _ in rows)]))
    print(f'inputs {sum(number for _, number in rows)}, broken {[*rows].count(BROKEN)}')
    return broken + [*rows].count(BROKEN)


def failures() -> int:
    """Let a share of writes and allocations fail; return whether a test failed."""
    share = str(random.randrange(SHARES))
    print(f'share {share} of {SHARES} of the failures', flush=True)
    command = [sys.executable, '-m', 'pytest', '-q', '-rP', '-p', 'no:cacheprovider']
    return subprocess.run(
        [*command, str(Path(__file__).with_name('test_failures.py'))],
        env={**os.environ, 'SURFEL_MAPPER_EVERY_FAILURE': share},
        check=False,
    ).returncode


def in_processes(module: str, names: list[str], folder: str, seconds: float) -> None:
    """Run a module with all names, as many at a time as there are cores."""
    cores = min(os.cpu_count() or 1, len(names))
    each_s = max(seconds * cores / len(names) - START_S, LEAST_S)
    command = [sys.executable, '-m', f'test.fuzz.{module}', folder, str(each_s)]
    running = [
        subprocess.Popen([*command, *names[core::cores]], stderr=subprocess.PIPE, text=True)
        for core in range(cores)
    ]
    for process in running:
        _, text = process.communicate()  # hundreds of lines, on what is instrumented
        if process.returncode:
            print(text, file=sys.stderr)


BROKEN = ('', 0)
"""Row of a harness that an input broke."""


def row(name: str, folder: Path) -> tuple[str, int]:
    """Return a harness's row of the table and number of inputs; print what broke it."""
    logs = [folder / f'{name}.{module}.log' for module in ('search', 'measure')]
    texts = [path.read_text(errors='replace') if path.exists() else '' for path in logs]
    for text in texts:
        if not text.endswith('\nexit 0\n'):
            print(f'{name}:', *texts, sep='\n')
            return BROKEN
    found = [int(number) for number in re.findall(r'^Done (\d+) runs', texts[0], re.MULTILINE)]
    cost = json.loads(texts[1].splitlines()[-3])
    text = (
        f'| {name} | {sum(found)} | {cost["inputs"]} | {cost["used"] / 2**20:.0f} | '
        f'{cost["ratio"]:.1f} | {1e3 * cost["seconds"]:.0f} |'
    )
    return text, sum(found) + cost['inputs']


if __name__ == '__main__':
    sys.exit(main())
