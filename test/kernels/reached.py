# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Lists the kernels that a run of tests did not compile: `python -m test.kernels.reached CACHE`.

CACHE is the directory that NUMBA_CACHE_DIR named in that run. numba keeps one folder there
for each folder of sources, and names the index file of a kernel after its module and itself. A
module counts as reached if one of its kernels has such a file: others may be inlined.
"""

from __future__ import annotations

import ast
from pathlib import Path
import sys

from numba.core.caching import _CacheLocator

PACKAGE = Path(__file__).parents[2] / 'surfel_mapper'


def kernel_modules() -> dict[str, Path]:
    """Return the modules that define kernels, by the names of their folder and themselves."""
    found = {}
    for path in sorted(PACKAGE.glob('**/kernels/*.py')):
        tree = ast.parse(path.read_text(encoding='utf-8'))
        functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
        decorators = [ast.unparse(each) for node in functions for each in node.decorator_list]
        if any('cache=True' in each for each in decorators):
            found[path.relative_to(PACKAGE).as_posix()] = path
    return found


def main(cache: Path) -> int:
    """Print the modules of which no kernel was compiled; return how the process ends."""
    modules = kernel_modules()
    missing = []
    for name, path in modules.items():
        folder = cache / _CacheLocator.get_suitable_cache_subpath(str(path))
        if not any(folder.glob(f'{path.stem}.*.nbi')):
            missing.append(name)
    for name in missing:
        print(f'{name}: no test of this run called a kernel of it')
    print(f'{len(modules) - len(missing)} of {len(modules)} kernel modules reached')
    return 1 if missing or not modules else 0


if __name__ == '__main__':
    sys.exit(main(Path(sys.argv[1])))
