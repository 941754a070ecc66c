# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of runs draws each recorded run, and benches add theirs to its files."""

from importlib.util import module_from_spec, spec_from_file_location
import json
from types import SimpleNamespace
import xml.etree.ElementTree as ElementTree

from test.bench import __main__ as bench
from test.settings import ROOT

SVG = '{http://www.w3.org/2000/svg}'


def hook():
    spec = spec_from_file_location('draw', ROOT / 'docs/figures/draw.py')
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_value_is_a_dot_and_the_label_has_the_median():
    runs = [
        {'cpu': cpu, 'rows': [{'scan': 'street', 'voxel_m': 0.5, 'total_ms': ms}, {'scan': 'x'}]}
        for cpu, ms in (('one', 4.0), ('two', 9.0), ('two', 5.0))
    ]
    text = hook().drawing(runs, 'total_ms', 'ms')

    drawn = ElementTree.fromstring(text)
    dots = [g for g in drawn.iter(f'{SVG}g') if g.get('id', '').startswith('line2d')]
    uses = [len(list(g.iter(f'{SVG}use'))) for g in dots]
    assert uses.count(2) == 1  # the two runs of one machine
    assert hook().points(runs, 'total_ms') == {
        'street, 0.5 m': [(4.0, 'one'), (9.0, 'two'), (5.0, 'two')]
    }
    assert 'street, 0.5 m: 5' in text


def test_only_the_page_of_runs_is_changed():
    pages = [SimpleNamespace(file=SimpleNamespace(src_uri=uri)) for uri in ('runs.md', 'node.md')]
    texts = [hook().on_page_markdown('a <!-- runs --> b', page) for page in pages]
    assert texts[0].count('data:image/svg+xml') == sum(map(len, hook().COLUMNS.values()))
    assert texts[1] == 'a <!-- runs --> b'


def test_recorded_runs_are_added_to_the_files_of_their_benches(tmp_path):
    rows = [{'bench': 'lum', 'load': 1.0, 'compute_ms': 3.0}, {'bench': 'real', 'load': 2.0}]
    for day in ('2026-11-27', '2026-11-28'):
        bench.record(tmp_path, rows, {'command': 'c', 'date': day, 'cpu': 'one'})

    first, second = json.loads((tmp_path / 'lum.json').read_text())
    assert first == {**second, 'date': '2026-11-27'}
    assert second['rows'] == [{'compute_ms': 3.0}]
    assert second['load'] == 1.0
    assert len(json.loads((tmp_path / 'real.json').read_text())) == 2
