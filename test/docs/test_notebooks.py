# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The notebooks are those of the pages of the tutorials, and run to their last cell."""

from __future__ import annotations

from test import extras
from test.docs.notebooks import executed, pages, python_steps, TUTORIALS, written

pytestmark = extras.needs('nbformat', 'nbclient', 'ipykernel')


def test_a_cell_ends_where_the_page_shows_an_output():
    block = '>>> a = 1\n>>> a\n1\n>>> b = 2\n>>> 1 / 0\nTraceback (most recent call last):\n'
    block += '    ...\nZeroDivisionError: ...\n>>> for i in [a]:\n...     pass\n'
    assert list(python_steps(block)) == [
        ('a = 1\na', False),
        ('b = 2', False),
        ('1 / 0', True),
        ('for i in [a]:\n    pass', False),
    ]


def test_notebooks_are_those_of_the_pages():
    names = {path.name for path in TUTORIALS.glob('*.ipynb')}
    assert names == {page.with_suffix('.ipynb').name for page in pages()}
    old = [
        page.name
        for page in pages()
        if page.with_suffix('.ipynb').read_text(encoding='utf-8') != written(page)
    ]
    assert old == [], 'python -m test.docs.notebooks writes them'


def test_a_notebook_runs(tmp_path):
    book = executed(TUTORIALS / 'python.md', tmp_path)
    cells = [cell for cell in book.cells if cell.cell_type == 'code']
    shown = [cell for cell in cells if cell.outputs]
    assert len(shown) > len(cells) / 2
    for cell in cells:
        failed = any(output.output_type == 'error' for output in cell.outputs)
        assert failed == ('raises-exception' in cell.metadata.get('tags', [])), cell.source
    import nbformat

    assert len(nbformat.writes(book)) < 4_000_000
    assert (tmp_path / 'folder/room.npz').is_file()
