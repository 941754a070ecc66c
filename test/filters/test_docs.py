# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""docs/filters.md: its chain loads, its example of an own filter runs, its table is complete."""

from __future__ import annotations

import configparser
from importlib import import_module
import inspect
from pathlib import Path
import re

import pytest

from surfel_mapper.errors import ConfigError
from surfel_mapper.filters import registry
from surfel_mapper.filters.chain import Chain
from surfel_mapper.filters.registry import all_filters

PAGE = (Path(__file__).parents[2] / 'docs/filters.md').read_text(encoding='utf-8')


pytestmark = pytest.mark.usefixtures('own_registry')


def blocks(language):
    return re.findall(rf'```{language}\n(.*?)```', PAGE, re.DOTALL)


def test_the_chain_loads(tmp_path):
    (text,) = blocks('yaml')
    (tmp_path / 'chain.yaml').write_text(text)
    names = ('1 remove_nan', '2 body_box', '3 range_limit', '4 voxel_grid')
    assert Chain.load(tmp_path / 'chain.yaml').names == names


def test_the_example_of_an_own_filter_runs_and_is_checked_like_others(tmp_path, monkeypatch):
    (tmp_path / 'documented_filter.py').write_text('\n'.join(blocks('python')))
    monkeypatch.syspath_prepend(tmp_path)
    module = import_module('documented_filter')  # runs the assertions of the page
    assert registry.find('drop_dim') is module.DropDim
    with pytest.raises(ConfigError, match=r'min_intensity: -1, expected a value in \[0, inf\]'):
        Chain.from_list([{'drop_dim': {'min_intensity': -1}}])


def test_a_package_with_the_entry_point_brings_its_filter(tmp_path, monkeypatch):
    package, info = tmp_path / 'my_package', tmp_path / 'my_package-1.0.dist-info'
    for folder in (package, info):
        folder.mkdir()
    (package / '__init__.py').touch()
    (package / 'filters.py').write_text(blocks('python')[0])
    content = configparser.ConfigParser()
    content.read_string(blocks('ini')[0])
    ((group, points),) = content['options.entry_points'].items()
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n')
    (info / 'entry_points.txt').write_text(f'[{group}]{points}\n')
    monkeypatch.syspath_prepend(tmp_path)
    (found,) = Chain.from_list([{'drop_dim': {'min_intensity': 10}}]).filters
    assert type(found).__module__ == 'my_package.filters'
    assert type(found) in all_filters()


def test_the_table_has_every_filter_with_its_line():
    rows = re.findall(r'^\| `(\w+)` \| ([A-Za-z]*) \| (.*) \|$', PAGE, re.MULTILINE)
    assert rows == [
        (
            cls.name,
            cls.libpointmatcher.removesuffix('DataPointsFilter'),
            inspect.getdoc(cls).partition('\n')[0],
        )
        for cls in all_filters()
    ]
