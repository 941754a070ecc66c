# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
One process for each harness, forked from one that has imported everything.

An input that ends its process ends the search with one harness only, and the seconds that imports
take (instrumented ones 6) are spent once. What a process prints goes to ``NAME.MODULE.log``.
"""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import sys
import tempfile
import traceback


def each(names: list[str], run: Callable[[str], None], folder: Path, module: str) -> None:
    """Run a function with each name; write what it printed, and its exit code as last line."""
    for name in names:
        path = folder / f'{name}.{module}.log'
        child = os.fork()
        if not child:
            code = 1
            try:
                output = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
                os.dup2(output, 1)
                os.dup2(output, 2)
                tempfile.tempdir = tempfile.mkdtemp(dir=folder)
                run(name)
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        with path.open('a') as file:
            print(f'\nexit {code}', file=file)
