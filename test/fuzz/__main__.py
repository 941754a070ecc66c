# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Search for inputs that break a harness: ``python -m test.fuzz [NAME ...] --seconds 60``.

Each harness runs in two processes of its own. Atheris searches for exceptions that are not ours,
2 GB and hangs. Then inputs are measured without instruments for as long: the seeds, what atheris
found, and mutations of both, by the limits of oracle.py: 64 MiB and 20 bytes a byte, 0.2 s and
100 ns a byte.
A process ends at its first finding, in a file whose name is printed; ``--input FILE`` tries it
again. The last lines are a table of the worst costs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.util import find_spec
import json
from pathlib import Path
import subprocess
import sys
import tempfile

from surfel_mapper.cli._arguments import positive_int
from test.fuzz.harnesses import HARNESSES


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    result = argparse.ArgumentParser(prog='python -m test.fuzz', description='Search for crashes.')
    result.add_argument('names', nargs='*', metavar='NAME', help=f'of {", ".join(HARNESSES)}')
    result.add_argument(
        '--seconds', type=positive_int, default=60, help='of each; default: %(default)s'
    )
    result.add_argument('--input', type=Path, metavar='FILE', help='try one input')
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the number of harnesses that broke."""
    args = parser().parse_args(arguments)
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
    rows = [searched(name, args.seconds) for name in names]
    print('\n'.join([*HEAD, *(row for row in rows if row)]))
    return sum(row is None for row in rows)


HEAD = (
    '| input | atheris | measured | most MiB | most bytes per byte above 64 MiB | most ms |',
    '|---|---|---|---|---|---|',
)


def searched(name: str, seconds: int) -> str | None:
    """Search with one harness; return its row of the table, or None if an input broke it."""
    with tempfile.TemporaryDirectory(prefix='surfel_mapper-corpus-') as corpus:
        for number, data in enumerate(HARNESSES[name].corpus()):
            Path(corpus, str(number)).write_bytes(data)
        found = run('search', name, corpus, seconds)
        costs = run('measure', name, corpus, seconds) if found else None
    if not found or not costs:
        return None
    last = [line for line in found.stderr.splitlines() if line.startswith('Done ')]
    cost = json.loads(costs.stdout.splitlines()[-1])
    row = (
        f'| {name} | {last[-1].split()[1] if last else "?"} | {cost["inputs"]} | '
        f'{cost["used"] / 2**20:.0f} | {cost["ratio"]:.1f} | {1e3 * cost["seconds"]:.0f} |'
    )
    print(row, flush=True)
    return row


def run(
    module: str, name: str, corpus: str, seconds: int
) -> subprocess.CompletedProcess[str] | None:
    """Run a search in a process of its own; print what broke it, and return None then."""
    command = [sys.executable, '-m', f'test.fuzz.{module}', name, corpus, str(seconds)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return done
    print(f'{name}: {module}: exit {done.returncode}', done.stdout, done.stderr, sep='\n')
    return None


if __name__ == '__main__':
    sys.exit(main())
