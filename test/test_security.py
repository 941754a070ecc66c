# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Promises of SECURITY.md about the source, checked in the source; files stay in their folder.

Readers of damaged and hostile input are tested in test/fuzz, the node in test/ros.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
import re

import pytest

from surfel_mapper.config import load_config, OutputConfig
from surfel_mapper.errors import ConfigError

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'surfel_mapper'

MODULES = {'pickle', 'cPickle', 'marshal', 'shelve', 'dill', 'cloudpickle', 'joblib', 'subprocess'}
"""Functions that run programs, or code from a file."""

CALLS = {'eval', 'exec', 'compile', '__import__', 'os.system', 'os.popen', 'tempfile.mktemp'}

STARTS_RERUN = {'server.py': ['subprocess']}
"""The one module that starts a program: the server of rerun, with arguments of our own."""

SOURCES = sorted(PACKAGE.rglob('*.py'))


def name_of(node):
    """Return the dotted name of a called function."""
    if isinstance(node, ast.Attribute):
        return f'{name_of(node.value)}.{node.attr}'
    return node.id if isinstance(node, ast.Name) else ''


@cache
def searched(path):
    """Return the dangers in a file, and whether it imports by a text; parsed once."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding='utf-8'))))
    calls = (name_of(node.func) for node in nodes if isinstance(node, ast.Call))
    return dangers(nodes), any(name.endswith('import_module') for name in calls)


def dangers(nodes):
    """Return the calls among the nodes of a source that run external code or programs."""
    found = []
    for node in nodes:
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.split('.')[0] in MODULES]
        elif isinstance(node, ast.ImportFrom) and (node.module or '').split('.')[0] in MODULES:
            found.append(node.module)
        elif isinstance(node, ast.Call):
            found += dangers_of_call(node)
    return found


def dangers_of_call(call):
    name = name_of(call.func)
    given = {word.arg: word.value for word in call.keywords}
    pickles = given.get('allow_pickle')
    arguments = [name_of(argument) for argument in (*call.args, *given.values())]
    if name in CALLS or re.match(r'os\.(exec|spawn)', name):
        return [name]
    is_refused = isinstance(pickles, ast.Constant) and pickles.value is False
    if name == 'np.save' or not (is_refused or (pickles is None and name != 'np.load')):
        return [f'{name} may pickle']
    if 'shell' in given:
        return [f'{name} with a shell']
    if name in ('yaml.load', 'yaml.load_all'):
        safe = {'yaml.SafeLoader', 'yaml.BaseLoader'}
        loads = [n for n in ast.walk(call) if isinstance(n, ast.Attribute)]
        return [] if {name_of(n) for n in loads} & safe else [name]
    return [a for a in arguments if a in ('eval', 'exec')]


def test_no_source_unpickles_evaluates_or_starts_programs():
    found = {path: searched(path)[0] for path in SOURCES}
    assert {path.name: faults for path, faults in found.items() if faults} == STARTS_RERUN
    assert len(found) > 100


@pytest.mark.parametrize(
    'source',
    [
        'import pickle',
        'from subprocess import run',
        'eval(x)',
        'os.system(x)',
        'os.execv(x, y)',
        'np.load(x)',
        'np.lib.format.read_array(x, allow_pickle=True)',
        'run(x, shell=True)',
        'yaml.load(x, yaml.Loader)',
    ],
)
def test_dangerous_calls_are_found(source):
    assert dangers(ast.walk(ast.parse(source)))


IMPORTERS = {
    '__init__.py': 'public names of this package',
    'cli/main.py': 'verbs of this package',
    'libraries.py': 'fixed names of libraries',
    'filters/__init__.py': 'public names of this package',
    'filters/registry.py': 'modules in a folder of this package',
    'layers/registry.py': 'places that code registered',
    'ros/bond.py': 'one fixed package',
    'ros/layer_outputs.py': 'types that layers name',
    'ros/message_types.py': 'types of a bag, of packages that are looked up before',
}
"""Modules that import by a text, and where the text comes from."""


def test_only_known_modules_import_by_a_text():
    found = {path.relative_to(PACKAGE).as_posix() for path in SOURCES if searched(path)[1]}
    assert found == {*IMPORTERS}


MENDED = {
    'numpy': '1.22',  # CVE-2021-41495, -41496, -33430, -34141
    'scipy': '1.10',  # CVE-2023-25399, -29824
    'PyYAML': '5.4',  # CVE-2020-14343
    'pyarrow': '14.0.1',  # CVE-2023-47248: a Parquet file ran code that it contained
    'dask': '2021.10',  # CVE-2021-42343
    'distributed': '2021.10',  # CVE-2021-42343
    'cryptography': '42.0.4',  # CVE-2024-26130
}
"""
The first version without a known vulnerability that concerns this package.

Known, and of no concern here: tqdm before 4.66.3, in its command line; pyarrow before 23.0.1, in
its IPC format.
"""


def requirements():
    """Return all requirements in setup.py, by the name of their list."""
    tree = ast.parse((ROOT / 'setup.py').read_text(encoding='utf-8'))
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.List):
            for item in node.value.elts:
                if isinstance(item, ast.Constant):
                    yield item.value
                elif isinstance(item, ast.JoinedStr):
                    yield item.values[0].value


def test_every_dependency_has_a_lower_bound():
    found = list(requirements())
    assert len(found) > 15
    unbound = [name for name in found if not re.match(r'[\w.\[\]-]+[>=]=\d', name)]
    assert unbound == []


@pytest.mark.parametrize('name', MENDED)
def test_no_lower_bound_allows_a_version_that_is_known_to_be_vulnerable(name):
    found = [text for text in requirements() if re.match(rf'{name}>=', text)]
    assert found
    for text in found:
        bound = re.match(r'[\d.]+', text.partition('>=')[2]).group()
        assert numbers(bound) >= numbers(MENDED[name])


def numbers(version):
    """Return the numbers of a version, which compare as versions do."""
    return [int(number) for number in version.split('.')]


@pytest.mark.parametrize('name', ['', '.', '..', '.x', 'a/b', '/etc/x', 'a\\b', 'a\0b', '../a'])
def test_names_of_maps_that_lead_elsewhere_are_refused(name):
    with pytest.raises(ConfigError, match='map_name'):
        OutputConfig(map_name=name)


def test_an_error_in_a_file_does_not_say_what_is_in_it(tmp_path):
    path = tmp_path / 'shadow'
    path.write_text('root: [secret\nuser: x: y\n')
    with pytest.raises(ConfigError) as raised:
        load_config(path)
    assert 'secret' not in str(raised.value)
    assert 'line 2' in str(raised.value)


def test_a_map_is_not_saved_through_a_link_that_leads_elsewhere(tmp_path):
    pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
    from surfel_mapper.config import Config
    from surfel_mapper.pipeline import Mapper
    from surfel_mapper.ros.map_files import save_map

    outside, maps = tmp_path / 'precious', tmp_path / 'maps'
    outside.write_text('as it was')
    maps.mkdir()
    settings = {'pose.source': 'identity', 'output.directory': str(maps)}
    for suffix in ('ply', 'npz'):
        link = maps / f'map.{suffix}'
        link.symlink_to(outside)
        with pytest.raises(ConfigError, match='leads out of output'):
            save_map(Mapper(Config.from_mapping(settings)))
        link.unlink()
    assert outside.read_text() == 'as it was'
    assert list(maps.iterdir()) == []
