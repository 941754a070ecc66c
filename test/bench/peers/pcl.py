# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""PCL has no package for Python: small programs that time it are compiled if possible."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import shutil
import subprocess

from test.bench.options import Options

INCLUDE = ('/usr/include/pcl-1.13', '/usr/include/eigen3')


def compiled(name: str, libraries: Sequence[str], options: Options) -> Path | None:
    """Return the program compiled from a source beside this file; None if that fails."""
    compiler = shutil.which('g++')
    if compiler is None:
        return None
    source = Path(__file__).with_name(f'{name}.cpp')
    target = options.cache / name
    target.parent.mkdir(parents=True, exist_ok=True)
    command = [compiler, '-std=c++14', '-O2', '-w', str(source), '-o', str(target)]
    command += [f'-I{path}' for path in INCLUDE]
    command += [f'-lpcl_{library}' for library in libraries] + ['-Wl,--allow-shlib-undefined']
    done = subprocess.run(command, capture_output=True, check=False)
    return target if done.returncode == 0 else None
