# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Pages are in the menu, links lead to files and headings, the reference covers public names."""

from __future__ import annotations

from collections import defaultdict
from importlib import import_module
import re

import yaml

import surfel_mapper
from surfel_mapper import filters
from surfel_mapper.cli.main import VERBS
from surfel_mapper.pipeline.drops import REMEDIES
from test.settings import ROOT

DOCS = ROOT / 'docs'
PAGES = sorted(DOCS.rglob('*.md'))
README = ROOT / 'README.md'
TEXTS = [README, ROOT / 'CONTRIBUTING.md', ROOT / 'SECURITY.md', *PAGES]


def without_code(text):
    return re.sub(r'```.*?```|`[^`\n]*`', '', text, flags=re.DOTALL)


def everything(*patterns):
    """Return the texts of files of the repository, one behind the other."""
    paths = (path for pattern in patterns for path in sorted(ROOT.glob(pattern)))
    return ''.join(path.read_text(encoding='utf-8') for path in paths)


def anchors(path):
    """Return the anchors of the headings of a page, as GitHub and mkdocs make them."""
    text = re.sub(r'```.*?```', '', path.read_text(encoding='utf-8'), flags=re.DOTALL)
    headings = re.findall(r'^#+ +(.+)$', text, flags=re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', it).strip().lower().replace(' ', '-') for it in headings}


def menu(entries):
    """Yield the pages of the menu of mkdocs.yml."""
    for entry in entries:
        for value in [entry] if isinstance(entry, str) else entry.values():
            yield from menu(value) if isinstance(value, list) else [value]


def test_every_page_is_in_the_menu_once():
    config = yaml.safe_load((ROOT / 'mkdocs.yml').read_text(encoding='utf-8'))
    listed = sorted(menu(config['nav']))
    assert listed == sorted(page.relative_to(DOCS).as_posix() for page in PAGES)


def test_pages_follow_the_light_or_dark_style_of_the_reader():
    config = yaml.safe_load((ROOT / 'mkdocs.yml').read_text(encoding='utf-8'))
    styles = {entry['media']: entry['scheme'] for entry in config['theme']['palette']}
    assert styles == {
        '(prefers-color-scheme: light)': 'default',
        '(prefers-color-scheme: dark)': 'slate',
    }


def test_the_drawing_names_parts_that_exist():
    text = (DOCS / 'images' / 'flow.svg').read_text(encoding='utf-8')
    parts = re.findall(r'>([a-z]+)/[^<]*<', text)
    assert len(parts) > 5
    assert [part for part in parts if not (ROOT / 'surfel_mapper' / part).is_dir()] == []


def test_links_lead_to_files_and_headings():
    broken = []
    for path in TEXTS:
        for link in re.findall(r'\]\(([^)\s]+)\)', without_code(path.read_text(encoding='utf-8'))):
            if '://' in link:
                continue
            name, _, anchor = link.partition('#')
            target = (path.parent / name) if name else path
            if not target.exists() or (anchor and anchor not in anchors(target)):
                broken.append(f'{path.name}: {link}')
            elif path in PAGES and not target.resolve().is_relative_to(DOCS):
                broken.append(f'{path.name}: {link} is not part of the site')
    assert broken == []


def reference():
    """Return the full names that the reference describes."""
    names = set()
    for name, members in re.findall(
        r'^::: (\S+)\n((?:    .*\n)*)', everything('docs/api/*.md') + '\n', re.MULTILINE
    ):
        listed = re.findall(r'^        - (\w+)$', members, re.MULTILINE)
        names.update(f'{name}.{member}' for member in listed)
        if not listed:
            names.add(name)
    return names


def imported(text):
    """Yield the full names that a text imports from the package, or uses of its modules."""
    for module, names in re.findall(r'from (surfel_mapper[\w.]*) import (\([^)]*\)|.*)', text):
        for name in re.findall(r'\w+', names):
            yield f'{module}.{name}'
            for used in set(re.findall(rf'\b{name}\.(\w+)', text)):
                yield f'{module}.{name}.{used}'


def room(name):
    """Return the part of the package that a name belongs to."""
    return name.split('.')[1]


def test_the_reference_has_every_public_name():
    described = {name.rpartition('.')[2] for name in reference()}
    assert {name for name in dir(surfel_mapper) if name[0] != '_'} <= described


def test_the_reference_has_every_name_that_pages_and_examples_import():
    described = reference()
    missing = set()
    texts = everything('docs/*.md', 'docs/tutorials/*.md', 'examples/*.py', 'README.md')
    for module, names in re.findall(r'from (surfel_mapper\.[\w.]+) import ([\w, ]+)', texts):
        if module == 'surfel_mapper.config':
            continue  # by the page of settings
        for name in names.split(','):
            thing = getattr(import_module(module), name.strip())
            home = getattr(thing, '__module__', module)  # constants do not carry it
            full = f'{home}.{getattr(thing, "__name__", name.strip())}'
            if full not in described:
                missing.add(full)
    assert missing == set()


def test_the_reference_has_only_names_that_other_parts_or_pages_use():
    """Names are handed on, used beyond their part, or types in a part's signatures."""
    public, parts = set(), defaultdict(str)
    for path in (ROOT / 'surfel_mapper').rglob('*.py'):
        own = '' if path.name == '__init__.py' else room('.'.join(path.relative_to(ROOT).parts))
        text = path.read_text(encoding='utf-8')
        public.update(name for name in imported(text) if room(name) != own)
        parts[own] += text
    public.update(
        imported(everything('docs/*.md', 'docs/tutorials/*.md', 'examples/*.py', 'README.md'))
    )
    public.update(f'{getattr(filters, name).__module__}.{name}' for name in filters.__all__)
    whole = [name for name in reference() if (ROOT / f'{name.replace(".", "/")}.py').is_file()]
    assert whole == [], 'list the members of a module that are public'
    private = []
    for name in reference() - public:
        own = name.rpartition('.')[2]
        if not re.search(rf'(->|: )[^\n#]*\b{own}\b', parts[room(name)]):
            private.append(name)
    assert private == []


def test_the_readme_is_at_most_120_lines():
    assert len(README.read_text(encoding='utf-8').splitlines()) <= 120


def test_the_page_of_commands_has_every_verb():
    page = everything('docs/commands.md')
    assert [verb for verb in VERBS if f'| `surfel-mapper {verb}' not in page] == []


def test_pages_have_every_topic_and_service_of_the_node():
    pages = everything('docs/inputs.md', 'docs/outputs.md', 'docs/node.md')
    sources = everything('surfel_mapper/ros/*.py', 'surfel_mapper/layers/**/*.py')
    names = set(re.findall(r"'(~/[a-z_]+[a-z])'", sources))
    assert len(names) > 15
    assert sorted(name for name in names if f'`{name}`' not in pages) == []


def test_the_page_of_symptoms_has_every_cause_that_has_a_remedy():
    page = everything('docs/troubleshooting.md')
    assert [cause for cause in REMEDIES if f'`{cause}`' not in page] == []


def test_pictures_are_small():
    sizes = {path.name: path.stat().st_size for path in (DOCS / 'images').iterdir()}
    assert sizes.pop('drive.webp') < 1_500_000  # of 15 seconds
    assert {name: size for name, size in sizes.items() if size > 200_000} == {}
