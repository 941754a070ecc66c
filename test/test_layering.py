# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A module imports its own folder and lower levels, and each foreign package has one home.

Reads the imports from the source, those inside functions too, so that nothing has to be
installed and nothing hides behind a lazy import.
"""

from __future__ import annotations

import ast
from pathlib import Path
import sys

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'surfel_mapper'

LEVELS = {
    'errors': 0,
    'config': 1,
    'counters': 1,
    'geometry': 1,
    'kernels': 1,
    'scan': 1,
    'filters': 2,
    'mapping': 2,
    'alignment': 3,
    'depth': 3,
    'deskew': 3,
    'models': 3,
    'poses': 3,
    'tsdf': 3,
    'io': 4,
    'pipeline': 4,
    'offline': 5,
    'ros': 5,
    'simulation': 5,
    'viz': 5,
    'cluster': 6,
    'evaluation': 6,
    'cli': 7,
}
"""Level of every module and folder of the package."""

PACKAGE_LEVEL = 5
"""The package itself hands on names of up to level 4."""

HOMES = {
    'backports': 'io/bag',  # zstd
    'builtin_interfaces': 'ros/',
    'compression': 'io/bag',  # zstd from Python 3.14 on
    'dask': 'cluster/',
    'diagnostic_msgs': 'ros/',
    'distributed': 'cluster/',
    'ezdxf': 'io/dxf',
    'geometry_msgs': 'ros/',
    'lifecycle_msgs': 'ros/',
    'llvmlite': 'kernels/',
    'lz4': 'io/bag',
    'lzf': 'io/pcd',
    'PIL': 'io/compressed_image',
    'matplotlib': 'viz/',
    'nav_msgs': 'ros/',
    'numba': 'kernels/',
    'pyarrow': 'io/parquet',
    'rcl_interfaces': 'ros/',
    'rclpy': 'ros/',
    'rerun': 'viz/',
    'rosbags': 'io/bag',  # bag.py reads, bag_writer.py writes
    'rosgraph_msgs': 'ros/',
    'rosidl_runtime_py': 'ros/',
    'sensor_msgs': 'ros/',
    'std_msgs': 'ros/',
    'std_srvs': 'ros/',
    'tf2_msgs': 'ros/',
    'tf2_ros': 'ros/',
    'visualization_msgs': 'ros/',
}
"""Where alone a foreign package may be imported."""

ANYWHERE = {'numpy', 'scipy', 'tqdm', 'yaml'}
"""Foreign packages that any module above level 0 may import."""

MODULES = sorted(
    path.relative_to(PACKAGE).as_posix()
    for path in PACKAGE.rglob('*.py')
    if path != PACKAGE / '__init__.py'
)


def imports(path: Path) -> list[str]:
    """Return the full name of every module that a file imports."""
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}:{node.lineno}: relative import'
            names += [f'{node.module}.{alias.name}' for alias in node.names]
    return names


def part(name: str) -> str:
    """Return the first folder or module under the package: mapping, config."""
    return name.split('.')[1] if '.' in name else ''


def faults(module: str, names: list[str]) -> list[str]:
    """Return what is wrong with the imports of a module, given as its path in the package."""
    own = module.split('/')[0].removesuffix('.py')
    if own not in LEVELS:
        return [f'{own}: give it a level in this test']
    in_folder = '/' in module
    found = []
    for name in names:
        top = name.split('.')[0]
        if top == 'surfel_mapper':
            other = part(name)
            level = LEVELS.get(other, PACKAGE_LEVEL)
            if level >= LEVELS[own] and not (in_folder and other == own):
                found.append(f'{name}: level {level}, from level {LEVELS[own]}')
        elif top in HOMES:
            if not module.startswith(HOMES[top]):
                found.append(f'{name}: only in {HOMES[top]}')
        elif top in ANYWHERE:
            if LEVELS[own] == 0:
                found.append(f'{name}: level 0 has the standard library alone')
        elif top not in sys.stdlib_module_names:
            found.append(f'{name}: unknown; give it a home in this test')
    return found


@pytest.mark.parametrize('module', MODULES)
def test_imports_only_its_own_folder_and_lower_levels(module):
    assert faults(module, imports(PACKAGE / module)) == []


@pytest.mark.parametrize(
    ('module', 'name'),
    [
        ('errors.py', 'numpy'),
        ('mapping/surfel_map.py', 'surfel_mapper.pipeline.Mapper'),
        ('mapping/window.py', 'surfel_mapper.filters.chain'),
        ('poses/edge.py', 'surfel_mapper.deskew'),
        ('pipeline.py', 'numba'),
        ('io/ply.py', 'rosbags.highlevel'),
        ('cli/node.py', 'rclpy.node'),
        ('io/bag.py', 'requests'),
        ('ros/node.py', 'surfel_mapper.Mapper'),
        ('new.py', 'math'),
    ],
)
def test_an_import_upwards_sideways_or_away_from_home_is_found(module, name):
    assert len(faults(module, [name])) == 1


@pytest.mark.parametrize(
    ('module', 'name'),
    [
        ('kernels/moments.py', 'numba.njit'),
        ('mapping/surfel_map.py', 'surfel_mapper.mapping.surfels'),
        ('io/bag.py', 'rosbags.highlevel.AnyReader'),
        ('cli/main.py', 'surfel_mapper.__version__'),
        ('ros/node.py', 'surfel_mapper.pipeline.Mapper'),
    ],
)
def test_an_import_downwards_or_at_home_is_accepted(module, name):
    assert faults(module, [name]) == []


def test_the_package_itself_imports_nothing_foreign_and_nothing_with_ros_or_bags():
    names = imports(PACKAGE / '__init__.py')
    found = {part(name) for name in names if name.startswith('surfel_mapper')}
    foreign = {name.split('.')[0] for name in names} - sys.stdlib_module_names
    assert foreign == {'surfel_mapper'}
    assert not found & {'ros', 'viz', 'cluster', 'simulation', 'cli'}
    assert not any(name.startswith('surfel_mapper.io.bag') for name in names)


def test_every_folder_says_what_it_is():
    folders = {path.parent for path in PACKAGE.rglob('*.py')}
    silent = [
        folder.relative_to(ROOT).as_posix()
        for folder in sorted(folders)
        if not (folder / '__init__.py').exists()
        or ast.get_docstring(ast.parse((folder / '__init__.py').read_text())) is None
    ]
    assert silent == []


def test_a_long_file_says_at_its_top_why_it_is():
    long = [
        path
        for folder in ('surfel_mapper', 'test', 'examples')
        for path in (ROOT / folder).rglob('*.py')
        if path.read_text(encoding='utf-8').count('\n') > 300
    ]
    for path in long:
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding='utf-8'))) or ''
        assert '(Longer than other files: ' in docstring, path
    assert long  # else nothing was looked at
