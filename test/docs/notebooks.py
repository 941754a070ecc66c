# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Notebooks of the tutorials: ``python -m test.docs.notebooks`` makes them from pages and runs them.

A page is the source. Its text becomes cells of text, its Python and its commands cells of code,
one for each output that the page shows. They are written without outputs. The tests run one of
them, and the commands of all pages.
"""

from __future__ import annotations

import doctest
import os
from pathlib import Path
import re
import tempfile

from test.docs.test_tutorials import shell_path

TUTORIALS = Path(__file__).parents[2] / 'docs' / 'tutorials'

HINT = """\
*Made from [{name}]({name}); needs `pip install surfel_mapper` and, for the commands, a shell.*"""


def notebook(page):
    """Return the notebook of a page."""
    import nbformat.v4 as v4

    parts = re.split(r'^```(\w*)\n(.*?)^```\n', page.read_text('utf-8'), flags=re.M | re.S)
    cells = []
    for text, language, block in zip(
        parts[::3], [*parts[1::3], ''], [*parts[2::3], ''], strict=True
    ):
        if text.strip():
            cells.append(v4.new_markdown_cell(text.strip()))
        if language == 'pycon':
            cells += [python_cell(code, fails) for code, fails in python_steps(block)]
        elif language == 'console':
            commands = re.split(r'^\$ ', block, flags=re.M)[1:]
            cells += [v4.new_code_cell(f'%%bash\n{each.splitlines()[0]}') for each in commands]
        elif language:
            cells.append(v4.new_markdown_cell(f'```{language}\n{block}```'))
    cells.insert(1, v4.new_markdown_cell(HINT.format(name=page.name)))
    for number, cell in enumerate(cells):
        cell['id'] = f'cell-{number}'
    kernel = {'name': 'python3', 'display_name': 'Python 3', 'language': 'python'}
    return v4.new_notebook(cells=cells, metadata={'kernelspec': kernel})


def python_cell(code, fails):
    """Return a cell of code; one that shows an error may fail."""
    import nbformat.v4 as v4

    return v4.new_code_cell(code, metadata={'tags': ['raises-exception']} if fails else {})


def python_steps(block):
    """Yield the code of a block up to each shown output, and whether that is an error."""
    lines = []
    for example in doctest.DocTestParser().get_examples(block):
        if example.exc_msg is not None and lines:
            yield ''.join(lines).rstrip('\n'), False
            lines = []
        lines.append(example.source)
        if example.want:
            yield ''.join(lines).rstrip('\n'), example.exc_msg is not None
            lines = []
    if lines:
        yield ''.join(lines).rstrip('\n'), False


def pages():
    """Return the pages of the tutorials."""
    return sorted(TUTORIALS.glob('*.md'))


def written(page):
    """Return the text of the notebook of a page."""
    import nbformat

    return nbformat.writes(notebook(page)) + '\n'


def executed(page, folder):
    """Run the notebook of a page in a folder, with surfel-mapper ours; return it with outputs."""
    import nbclient
    import nbformat

    book = nbformat.read(page.with_suffix('.ipynb'), as_version=4)
    nbformat.validate(book)
    place = folder / 'folder'
    place.mkdir()
    saved = dict(os.environ)
    os.environ.update(PATH=shell_path(folder), PYTHONPATH=str(TUTORIALS.parents[1]))
    try:
        resources = {'metadata': {'path': str(place)}}
        return nbclient.NotebookClient(book, timeout=600, resources=resources).execute()
    finally:
        os.environ.clear()
        os.environ.update(saved)


if __name__ == '__main__':
    for tutorial in pages():
        tutorial.with_suffix('.ipynb').write_text(written(tutorial), encoding='utf-8')
        with tempfile.TemporaryDirectory() as made:
            executed(tutorial, Path(made))
