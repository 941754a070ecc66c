# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Search for inputs that break a harness: ``python -m test.fuzz [NAME ...] --seconds 60``.

Each harness runs in a process of its own, which atheris ends at the first finding: an exception
of another class, memory beyond the limit, or too much time. The input is written to a file whose
name is printed; ``--input FILE`` runs it again.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.util import find_spec
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
    return sum(searched(name, args.seconds) for name in names)


def searched(name: str, seconds: int) -> bool:
    """Search with one harness in a process of its own; return whether it broke."""
    with tempfile.TemporaryDirectory(prefix='surfel_mapper-corpus-') as corpus:
        for number, data in enumerate(HARNESSES[name].corpus()):
            Path(corpus, str(number)).write_bytes(data)
        command = [sys.executable, '-m', 'test.fuzz.search', name, corpus, str(seconds)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    last = [line for line in done.stderr.splitlines() if line.startswith('Done ')]
    print(f'{name}: {last[-1] if last else f"exit {done.returncode}"}', flush=True)
    if done.returncode:
        print(done.stdout, done.stderr, sep='\n')
    return done.returncode != 0


if __name__ == '__main__':
    sys.exit(main())
