# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A module imports its own folder and lower levels, and each foreign package has one home.

Reads the imports from the source, including those inside functions and those by name
(``import_module``), so that nothing has to be installed and no lazy import is missed.
Each test lists everything that is wrong, not the first.
"""

from __future__ import annotations

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
import re
import sys
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'surfel_mapper'

LEVELS = (
    {'compilation', 'errors', 'memory'},
    {'arguments', 'budget', 'kernels', 'libraries', 'map_formats'},
    {'config', 'counters', 'geometry', 'scan', 'threads'},
    {'filters', 'mapping'},
    {'alignment', 'models', 'poses', 'sensors', 'tsdf'},
    {'files', 'messages'},
    {'bags'},
    {'layers'},
    {'pipeline'},
    {'viz'},
    {'ros', 'simulation'},
    {'evaluation'},
    {'offline'},
    {'cluster'},
    {'cli'},
)
"""The rooms of the package, from the bottom up."""

LEVEL = {room: level for level, rooms in enumerate(LEVELS) for room in rooms}

PACKAGE_LEVEL = LEVEL['offline']
"""The package itself exports names of up to this level."""

HOMES = {
    'argcomplete': ('cli/main',),
    'backports': ('bags/',),  # zstd
    'bond': ('ros/',),
    'builtin_interfaces': ('ros/',),
    'compression': ('bags/',),  # zstd from Python 3.14 on
    'cryptography': ('cluster/',),
    'dask': ('cluster/',),
    'diagnostic_msgs': ('ros/',),
    'distributed': ('cluster/',),
    'geometry_msgs': ('ros/',),
    'lifecycle_msgs': ('ros/',),
    'kiss_matcher': ('evaluation/frames',),
    'laspy': ('files/las',),
    'lazrs': ('files/las',),
    'llvmlite': ('kernels/',),
    'lz4': ('bags/',),
    'lzf': ('files/pcd',),
    'PIL': ('messages/compressed_image', 'viz/turning_view'),
    'map_closures': ('alignment/recognition',),
    'matplotlib': ('viz/',),
    'open3d': ('mapping/surfels',),
    'pandas': ('mapping/surfels',),
    'nav_msgs': ('ros/',),
    'ouster': ('offline/ouster_pcap',),
    'numba': ('kernels/',),
    'pyarrow': ('files/parquet',),
    'rcl_interfaces': ('ros/',),
    'rclpy': ('ros/',),
    'rerun': ('viz/',),
    'rerun_bindings': ('viz/',),
    'mcap': ('bags/streamed_mcap',),
    'trimesh': ('files/triangles',),
    'rosbags': ('bags/_rosbags',),
    'rosgraph_msgs': ('ros/',),
    'rosidl_runtime_py': ('ros/',),
    'sensor_msgs': ('ros/',),
    'std_msgs': ('ros/',),
    'std_srvs': ('ros/',),
    'tf2_msgs': ('ros/',),
    'tf2_ros': ('ros/',),
    'visualization_msgs': ('ros/',),
}
"""The only places where a foreign package may be imported; kernels/ is any folder of that name."""

ANYWHERE = {'numpy', 'scipy', 'tqdm', 'yaml'}
"""Foreign packages that any module above level 0 may import."""

LAYER_SETTINGS = ('tsdf', 'esdf', 'models', 'dynamic', 'grid')
"""Attributes of a configuration that hold the settings of layers."""

CONFIGS = ('config', 'settings')
"""Names of variables that hold a configuration."""

MODULES = {
    path.relative_to(PACKAGE).as_posix(): path
    for path in sorted(PACKAGE.rglob('*.py'))
    if path != PACKAGE / '__init__.py'
}


class Source(NamedTuple):
    """The parts of a file that the tests look at."""

    imports: list[str]
    """The full name of every module imported."""

    classes: list[str]
    docstring: str
    num_lines: int
    layer_settings: list[str]
    """Line and name of every setting of a layer that is read from a configuration."""


@cache
def parsed(path: Path) -> Source:
    """Parse a file, once for all tests."""
    text = path.read_text(encoding='utf-8')
    tree = ast.parse(text)
    names, settings = imports_by_name(tree), []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}:{node.lineno}: relative import'
            names += [f'{node.module}.{alias.name}' for alias in node.names]
        elif isinstance(node, ast.Attribute) and is_layer_setting(node):
            settings.append(f'{node.lineno}: .{node.attr}')
    classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    docstring = ast.get_docstring(tree) or ''
    return Source(names, classes, docstring, text.count('\n'), settings)


def imports_by_name(tree: ast.Module) -> list[str]:
    """
    Return the modules of this package that a file imports by name.

    A name that is completed at run time stands for its folder, ``surfel_mapper.filters.*``. A
    variable stands for all names of modules in the file.
    """
    arguments = [
        node.args[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and getattr(node.func, 'attr', getattr(node.func, 'id', ''))
        in ('import_module', '__import__', 'find_spec', 'run_module')
    ]
    texts = [node for argument in arguments for node in ast.walk(argument)]
    if any(isinstance(argument, ast.Name) for argument in arguments):
        texts = list(ast.walk(tree))
    names = [
        node.value.partition(':')[0]
        for node in texts
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    words = [name for name in names if re.fullmatch(r'surfel_mapper(\.\w+)+\.?', name)]
    return [f'{name}*' if name.endswith('.') else name for name in words]


def is_layer_setting(node: ast.Attribute) -> bool:
    """Return whether an attribute is the settings of a layer in a configuration."""
    owner = getattr(node.value, 'attr', getattr(node.value, 'id', ''))
    return node.attr in LAYER_SETTINGS and owner.strip('_') in CONFIGS


def imports(path: Path) -> list[str]:
    """Return the full name of every module that a file imports."""
    return parsed(path).imports


def is_at_home(module: str, homes: tuple[str, ...]) -> bool:
    """Return whether a module is in one of some places."""
    return any(
        module.startswith(home) or (home == 'kernels/' and '/kernels/' in module) for home in homes
    )


def faults(module: str, names: list[str]) -> list[str]:
    """Return the faults in the imports of a module, given as its path in the package."""
    own = module.split('/')[0].removesuffix('.py')
    if own not in LEVEL:
        return [f'{module}: {own} has no level in this test']
    found = []
    for name in names:
        top, _, rest = name.partition('.')
        if top == 'surfel_mapper':
            other, *inner = rest.split('.')
            level = LEVEL.get(other, PACKAGE_LEVEL)
            is_own = '/' in module and other == own
            if level >= LEVEL[own] and not is_own:
                found.append(f'{name}: level {level}, from level {LEVEL[own]}')
            elif not is_own and any(part.startswith('_') for part in [other, *inner][:-1]):
                found.append(f'{name}: private to {other}/')
        elif top in HOMES:
            if not is_at_home(module, HOMES[top]):
                found.append(f'{name}: only in {", ".join(HOMES[top])}')
        elif top in ANYWHERE:
            if LEVEL[own] == 0:
                found.append(f'{name}: level 0 imports the standard library only')
        elif top not in sys.stdlib_module_names:
            found.append(f'{name}: unknown; give it a home in this test')
    return [f'{module}: {fault}' for fault in found]


def test_modules_import_their_own_folder_and_lower_levels():
    found = [fault for name, path in MODULES.items() for fault in faults(name, imports(path))]
    assert found == []


def test_only_layers_and_their_parts_read_the_settings_of_layers():
    found = [
        f'{name}:{setting}'
        for name, path in MODULES.items()
        if not name.startswith(('config/', 'layers/', *LAYER_SETTINGS))
        for setting in parsed(path).layer_settings
    ]
    assert found == []


def test_no_modules_import_each_other_in_a_circle():
    assert circle({dotted_name(name): imports(path) for name, path in MODULES.items()}) == []


def circle(imported: dict[str, list[str]]) -> list[str]:
    """
    Return the modules of a circle, given the names that each module imports.

    A name that is completed at run time adds nothing: a registry loads its own folder by it.
    """
    graph = {}
    for name, named in imported.items():
        whole = [other for other in named if not other.endswith('*')]
        modules = {other if other in imported else other.rpartition('.')[0] for other in whole}
        graph[name] = (modules & imported.keys()) - {name}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


BY_NAME = (
    ("import_module('surfel_mapper.files.maps')", ['surfel_mapper.files.maps']),
    ("def f():\n    return __import__('surfel_mapper.files')", ['surfel_mapper.files']),
    ("importlib.import_module(f'surfel_mapper.filters.{name}')", ['surfel_mapper.filters.*']),
    ("HOME = 'surfel_mapper.files.maps:save'\nimport_module(HOME)", ['surfel_mapper.files.maps']),
    ("import_module('bond.msg')", []),
)


def test_imports_by_name_are_read():
    assert [text for text, names in BY_NAME if imports_by_name(ast.parse(text)) != names] == []


def test_an_import_by_name_closes_a_circle_and_goes_up():
    text = "def _files():\n    return import_module('surfel_mapper.files.maps')"
    upward = imports_by_name(ast.parse(text))
    lower, higher = 'surfel_mapper.mapping.surfel_map', 'surfel_mapper.files.maps'

    assert set(circle({lower: upward, higher: [f'{lower}.SurfelMap']})) == {lower, higher}
    assert len(faults('mapping/surfel_map.py', upward)) == 1


def dotted_name(module: str) -> str:
    """Return the name to import a module by, given as its path in the package."""
    parts = module.removesuffix('.py').removesuffix('/__init__').split('/')
    return '.'.join(['surfel_mapper', *parts])


FORBIDDEN = (
    ('errors.py', 'numpy.linalg'),
    ('mapping/surfel_map.py', 'surfel_mapper.pipeline.Mapper'),
    ('mapping/window.py', 'surfel_mapper.filters.chain'),
    ('poses/buffer.py', 'surfel_mapper.sensors.deskew'),
    ('filters/chain.py', 'surfel_mapper.config._fields.setting'),
    ('pipeline/mapper.py', 'numba'),
    ('files/ply.py', 'rosbags.highlevel'),
    ('cli/node.py', 'rclpy.node'),
    ('bags/reader.py', 'requests'),
    ('ros/node.py', 'surfel_mapper.Mapper'),
    ('new.py', 'math'),
)

ALLOWED = (
    ('kernels/grouping.py', 'numba.njit'),
    ('tsdf/kernels/lookup.py', 'numba.njit'),
    ('config/stages.py', 'surfel_mapper.config._fields.setting'),
    ('mapping/surfel_map.py', 'surfel_mapper.mapping.surfels'),
    ('bags/_rosbags.py', 'rosbags.highlevel.AnyReader'),
    ('cli/main.py', 'surfel_mapper.__version__'),
    ('ros/node.py', 'surfel_mapper.pipeline.Mapper'),
)


def test_forbidden_imports_are_found_and_others_accepted():
    assert [case for case in FORBIDDEN if len(faults(case[0], [case[1]])) != 1] == []
    assert [case for case in ALLOWED if faults(case[0], [case[1]])] == []


def test_shared_kernels_are_used_by_two_parts():
    users: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        part = module.split('/')[0]
        for name in imports(path):
            if name.startswith('surfel_mapper.kernels.'):
                users.setdefault(name.split('.')[2], set()).add(part)
    shared = {path.stem for path in (PACKAGE / 'kernels').glob('[a-z]*.py')}
    assert {name for name in shared if len(users[name]) < 2} == set()


def test_the_package_itself_imports_nothing_foreign():
    names = imports(PACKAGE / '__init__.py')
    foreign = {name.split('.')[0] for name in names} - sys.stdlib_module_names
    assert foreign == {'surfel_mapper'}


def test_no_two_classes_share_a_name():
    homes: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        for name in parsed(path).classes:
            if not name.startswith('_'):
                homes.setdefault(name, []).append(module)
    assert {name: where for name, where in homes.items() if len(where) > 1} == {}


def test_every_folder_has_a_docstring():
    folders = sorted({path.parent for path in PACKAGE.rglob('*.py')})
    silent = [
        folder.relative_to(ROOT).as_posix()
        for folder in folders
        if not (folder / '__init__.py').exists() or not parsed(folder / '__init__.py').docstring
    ]
    assert silent == []


def test_no_verb_imports_another():
    folder = PACKAGE / 'cli'
    verbs = {path.stem for path in folder.glob('[a-z]*.py')} - {'main', 'start'}
    found = [
        f'cli/{verb}.py imports {name}'
        for verb in sorted(verbs)
        for name in imports(folder / f'{verb}.py')
        if name.startswith('surfel_mapper.cli.')
        and name.split('.')[2] in verbs | {'main', 'start'}
    ]
    assert 'replay' in verbs
    assert found == []
