# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Promises of SECURITY.md about the source, checked in the source; files stay in their folder.

Readers of damaged and hostile input are tested in test/fuzz, the node in test/ros.
"""

from __future__ import annotations

import ast
from pathlib import Path
import re

import pytest

from surfel_mapper.config import load_config, OutputConfig
from surfel_mapper.errors import ConfigError

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'surfel_mapper'

SOURCES = {
    path.relative_to(PACKAGE).as_posix(): path.read_text(encoding='utf-8')
    for path in sorted(PACKAGE.rglob('*.py'))
}

PROGRAMS = {'viz/server.py': ['subprocess']}
"""The one module that starts a program: the server of rerun, with arguments of our own."""

IMPORTED = re.compile(
    r'^ *(?:from|import) (c?[Pp]ickle|marshal|shelve|dill|cloudpickle|joblib|subprocess)\b', re.M
)

LOADED = re.compile(r'(?:np\.load|npy\.\w+_array)\((?!.*allow_pickle=False)|pickle=True')


def test_no_source_imports_pickles_or_programs():
    """The rules S of ruff (``make lint``) find eval, shells, mktemp and loaders of any YAML."""
    imported = {name: IMPORTED.findall(text) for name, text in SOURCES.items()}
    assert {name: modules for name, modules in imported.items() if modules} == PROGRAMS
    assert [name for name, text in SOURCES.items() if LOADED.search(text)] == []
    assert len(SOURCES) > 100


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
    found = {name for name, text in SOURCES.items() if 'import_module(' in text}
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
