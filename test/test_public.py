# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Public names, and the modules that importing the package loads: no ROS, no bags, no compiler."""

from __future__ import annotations

import ast
import doctest
import inspect
from pathlib import Path
import pydoc
import re
import subprocess
import sys

import pytest

import surfel_mapper

ROOT = Path(__file__).parents[1]

PUBLIC = [name for name in dir(surfel_mapper) if not name.startswith('_')]

HEAVY = ('dask', 'matplotlib', 'numba', 'numpy', 'rclpy', 'rosbags', 'scipy', 'yaml')


def loaded_by(code: str) -> set[str]:
    """Return the top-level modules that a fresh Python holds after running some code."""
    script = f'{code}\nimport sys\nprint(*{{name.split(".")[0] for name in sys.modules}})'
    done = subprocess.run(
        [sys.executable, '-c', script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_type_checkers_see_the_public_names():
    tree = ast.parse(Path(surfel_mapper.__file__).read_text(encoding='utf-8'))
    typed = {
        alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module.startswith('surfel_mapper')
        for alias in node.names
    }
    assert sorted(typed) == PUBLIC
    for name, module in typed.items():
        assert inspect.getmodule(getattr(surfel_mapper, name)).__name__.startswith(module)


def test_every_public_name_is_there_listed_and_the_same_each_time():
    for name in PUBLIC:
        assert getattr(surfel_mapper, name) is getattr(surfel_mapper, name)
        assert name in dir(surfel_mapper)


def own_members(of_class):
    """Return the members of a class and of those that it inherits from in this package."""
    found = {}
    for each in reversed(of_class.__mro__):
        if each.__module__.startswith('surfel_mapper'):
            found |= vars(each)
    return found.items()


def members():
    """Yield every public name, and those of public classes, with what carries its docstring."""
    for name in PUBLIC:
        value = getattr(surfel_mapper, name)
        yield name, value
        for of_class, member in own_members(value) if inspect.isclass(value) else ():
            member = member.fget if isinstance(member, property) else member
            member = getattr(member, '__func__', member)
            if inspect.isfunction(member) and not of_class.startswith('_'):
                yield f'{name}.{of_class}', member


def test_every_public_name_has_a_docstring():
    assert [name for name, member in members() if not inspect.getdoc(member)] == []


def test_functions_of_arrays_state_a_shape():
    silent = []
    for name, member in members():
        if inspect.isfunction(member):
            types = inspect.get_annotations(member).values()
            arrays = [each for each in types if re.match(r'Array|ArrayLike|npt\.', str(each))]
            if arrays and not re.search(r'\([A-Z\d]\w*,|\bshape\b', inspect.getdoc(member)):
                silent.append(name)
    assert silent == []


def test_functions_that_raise_say_so():
    silent = [
        name
        for name, member in members()
        if inspect.isfunction(member)
        and re.search(r'^ +raise ', inspect.getsource(member), re.M)
        and not re.search(r'Raises\n-{6}|\b[Rr]aises?\b', inspect.getdoc(member))
    ]
    assert silent == []


def test_an_unknown_name_is_refused_by_name():
    with pytest.raises(AttributeError, match=r"'surfel_mapper' has no attribute 'SurfelMop'"):
        surfel_mapper.SurfelMop  # noqa: B018


def test_importing_the_package_loads_nothing_heavy():
    assert not loaded_by('import surfel_mapper') & set(HEAVY)


def test_importing_all_public_names_loads_neither_ros_nor_bags_nor_pictures():
    loaded = loaded_by(f'from surfel_mapper import {", ".join(PUBLIC)}')
    assert {'numba', 'numpy'} <= loaded
    assert not loaded & {'dask', 'matplotlib', 'rclpy', 'rosbags'}


def test_without_numba_the_error_says_how_to_install_it():
    code = (
        'import sys\n'
        'sys.modules["numba"] = None\n'  # what Python does for a module that is not there
        'from surfel_mapper.errors import DependencyError\n'
        'try:\n'
        '    import surfel_mapper.kernels\n'
        'except DependencyError as error:\n'
        '    print(error)\n'
    )
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert 'pip install numba' in done.stdout
    assert 'Ubuntu 24.04' in done.stdout
    assert '--break-system-packages' in done.stdout
    assert '--system-site-packages' in done.stdout


def test_a_mapper_loads_neither_solvers_nor_models_nor_pictures():
    script = (
        'import sys\nfrom surfel_mapper.pipeline import Mapper\nMapper()\n'
        "late = ('scipy.spatial', 'scipy.sparse', 'scipy.linalg', 'surfel_mapper.models', "
        "'matplotlib', 'pyarrow', 'dask', 'rosbags')\n"
        'print([name for name in late if name in sys.modules])'
    )
    done = subprocess.run(
        [sys.executable, '-c', script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == '[]\n'


@pytest.mark.parametrize('name', sorted(PUBLIC))
def test_the_examples_of_docstrings_are_true(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    value = getattr(surfel_mapper, name)
    module = inspect.getmodule(value)
    (examples,) = doctest.DocTestFinder(recurse=False).find(value, name, module)
    assert len(examples.examples) > 0
    assert doctest.DocTestRunner().run(examples).failed == 0


def test_help_of_the_package_is_short():
    text = pydoc.plain(pydoc.render_doc(surfel_mapper))
    assert len(text.splitlines()) <= 300
    assert [name for name in PUBLIC if f' {name}' not in text] == []
