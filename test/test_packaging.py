# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The files that install the package agree with each other, and the executables start."""

from __future__ import annotations

import configparser
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
from xml.etree import ElementTree

import pytest
import yaml

import surfel_mapper

ROOT = Path(__file__).parents[1]
MANIFEST = ElementTree.parse(ROOT / 'package.xml').getroot()
SETUP = (ROOT / 'setup.py').read_text(encoding='utf-8')
APT_NAMES = {'pyyaml': 'yaml', 'pillow': 'pil'}  # python3-yaml, python3-pil
NO_RULE = {'mcap', 'numba'}  # no rosdep rule for Ubuntu 24.04


def test_the_version_is_the_same_everywhere():
    in_setup = re.search(r"version='([^']+)'", SETUP).group(1)
    assert {in_setup, MANIFEST.findtext('version')} == {surfel_mapper.__version__}


def test_the_citation_states_the_version():
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text(encoding='utf-8'))
    assert citation['version'] == surfel_mapper.__version__
    assert citation['license'] == MANIFEST.findtext('license')


def test_the_addresses_are_the_same_everywhere():
    site = re.search(r"^SITE = '([^']+)'", SETUP, flags=re.MULTILINE).group(1)
    in_setup = dict(re.findall(r"'(\w+)': f'{SITE}(/[^']*)'", SETUP))
    expected = {
        'website': site,
        'repository': site + in_setup['Source'],
        'bugtracker': site + in_setup['Issues'],
    }
    assert {url.get('type'): url.text for url in MANIFEST.iter('url')} == expected
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text(encoding='utf-8'))
    assert citation['url'] == expected['website']
    assert citation['repository-code'] == expected['repository']


def test_no_release_has_the_reserved_domain():
    release = yaml.safe_load((ROOT / '.github/workflows/release.yml').read_text(encoding='utf-8'))
    (check,) = (s['run'] for s in release['jobs']['build']['steps'] if 'grep' in s.get('run', ''))
    refused = subprocess.run(['bash', '-c', check], cwd=ROOT, capture_output=True, check=False)
    assert (refused.returncode == 1) == ('surfel-mapper.example' in SETUP)


def test_workflows_run_targets_of_the_makefile():
    makefile = (ROOT / 'Makefile').read_text(encoding='utf-8')
    targets = set(re.findall(r'^([a-z-]+):', makefile, flags=re.MULTILINE))
    named = set()
    for path in (ROOT / '.github/workflows').glob('*.yml'):
        for job in yaml.safe_load(path.read_text(encoding='utf-8'))['jobs'].values():
            for step in job['steps']:
                words = step.get('run', '').split()
                if words[:1] == ['make']:
                    named |= {word for word in words[1:] if '=' not in word}
    assert named
    assert named <= targets


def test_workflows_name_actions_by_digest_and_state_their_permissions():
    for path in (ROOT / '.github/workflows').glob('*.yml'):
        text = path.read_text(encoding='utf-8')
        used = re.findall(r'uses: (.*)', text)
        assert used
        assert all(re.fullmatch(r'[\w/-]+@[0-9a-f]{40}  # v[0-9.]+', action) for action in used)
        assert yaml.safe_load(text)['permissions'] == {'contents': 'read'}


def test_no_image_to_run_ends_as_root():
    targets = re.split(r'^FROM .* AS ', (ROOT / 'Dockerfile').read_text(), flags=re.MULTILINE)[1:]
    for target in targets:
        if not target.startswith('develop'):
            assert 'USER mapper' in target
            assert target.index('USER mapper') < target.index('compile\n')


def test_the_changelog_begins_with_what_is_to_come_or_with_this_version():
    changelog = (ROOT / 'CHANGELOG.rst').read_text(encoding='utf-8')
    headings = re.findall(r'^(.+)\n-{3,}$', changelog, flags=re.MULTILINE)
    assert headings[0] == 'Forthcoming' or headings[0].startswith(surfel_mapper.__version__)


def test_pixi_and_docker_state_the_bounds_of_setup():
    required = re.search(r'REQUIRED = \[(.*?)\n\]', SETUP, flags=re.DOTALL).group(1)
    bounds = dict(re.findall(r"^ *'([A-Za-z]+)([^']+)'", required, flags=re.MULTILINE))
    pixi = (ROOT / 'pixi.toml').read_text(encoding='utf-8')
    stated = dict(re.findall(r'^(\w[\w-]*) = "([^"]+)"$', pixi, flags=re.MULTILINE))
    stated['matplotlib'] = stated.pop('matplotlib-base')  # without the widgets of a desktop
    assert {name.lower(): bound for name, bound in bounds.items()}.items() <= stated.items()
    docker = (ROOT / 'Dockerfile').read_text(encoding='utf-8')
    pinned = dict(re.findall(r"'(numba|rosbags|mcap)([^']+)'", docker))
    assert pinned == {name: bounds[name] for name in ('numba', 'rosbags', 'mcap')}


def test_everything_pip_requires_is_known_to_rosdep_too():
    required = re.search(r'REQUIRED = \[(.*?)\n\]', SETUP, flags=re.DOTALL).group(1)
    names = {name.lower() for name in re.findall(r"^ *'([A-Za-z]+)", required, flags=re.MULTILINE)}
    keys = {node.text for node in MANIFEST.iter('exec_depend') if 'python3-' in node.text}
    known = {key.removeprefix('python3-').removesuffix('-pip') for key in keys}
    assert known == {APT_NAMES.get(name, name) for name in names - NO_RULE}


def test_every_ros_package_imported_is_a_dependency():
    from test.test_layering import HOMES, imports, MODULES, PACKAGE

    imported = {name.split('.')[0] for module in MODULES for name in imports(PACKAGE / module)}
    ros = {name for name in imported if HOMES.get(name) == 'ros/'}
    assert ros <= {node.text for node in MANIFEST.iter('exec_depend')}


def test_every_file_carries_the_licence():
    ours = [
        path
        for folder in ('surfel_mapper', 'test', 'launch_configs', 'scripts', 'examples', '.ci')
        for path in sorted((ROOT / folder).rglob('*'))
        if path.is_file() and path.suffix in {'.py', '.yaml', '.xml', ''}
    ]
    assert len(ours) > 20
    without = [
        path.relative_to(ROOT).as_posix()
        for path in [*ours, ROOT / 'setup.py', ROOT / 'Makefile', ROOT / 'package.xml']
        if 'SPDX-License-Identifier: Apache-2.0' not in path.read_text(encoding='utf-8')[:400]
    ]
    assert without == []


def test_colcon_makes_an_executable_that_takes_the_python_of_the_shell():
    settings = configparser.ConfigParser()
    settings.read(ROOT / 'setup.cfg')
    assert settings['build_scripts']['executable'] == '/usr/bin/env python3'


@pytest.mark.parametrize('name', ['node', 'replay'])
@pytest.mark.parametrize('python_in_prefix', [True, False])
def test_an_executable_runs_its_verb_with_the_python_of_its_prefix_or_else_of_the_shell(
    tmp_path, name, python_in_prefix
):
    prefix, shell = tmp_path / 'a prefix', tmp_path / 'shell'
    executable = prefix / 'lib' / 'surfel_mapper' / name
    executable.parent.mkdir(parents=True)
    shutil.copy(ROOT / 'scripts' / name, executable)  # with its mode, as the installers do
    for folder, is_there in ((prefix / 'bin', python_in_prefix), (shell, True)):
        if is_there:
            folder.mkdir()
            python = folder / 'python3'
            says = f'echo from {folder.name}'
            python.write_text(f'#!/bin/sh\n{says}\nexec "{sys.executable}" "$@"\n')
            python.chmod(0o755)

    done = subprocess.run(
        [executable, '--help'],
        env={**os.environ, 'PATH': f'{shell}:{os.environ["PATH"]}', 'PYTHONPATH': str(ROOT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )

    assert done.stdout.startswith(f'from {"bin" if python_in_prefix else "shell"}\n')
    assert f'surfel-mapper {name}' in done.stdout
