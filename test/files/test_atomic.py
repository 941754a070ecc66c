# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A file is replaced completely or not at all, also after errors while it is written."""

from contextlib import contextmanager, nullcontext
import math
import os
import shutil
import stat
import subprocess
import sys

import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.atomic import (
    finite_or_none,
    make_directory,
    remove_abandoned,
    replace_directory,
    replace_file,
    write_json,
)


def write(path, *chunks, then=None):
    """Replace a file by some bytes, and raise an error at the end if there is one."""
    with replace_file(path) as file:
        for chunk in chunks:
            file.write(chunk)
        if then is not None:
            raise then


def test_the_file_appears_at_the_end_and_not_before(tmp_path):
    path = tmp_path / 'map.ply'
    path.write_bytes(b'old')
    with replace_file(path) as file:
        file.write(b'new and longer')
        file.flush()
        assert path.read_bytes() == b'old'
    assert path.read_bytes() == b'new and longer'
    assert os.listdir(tmp_path) == ['map.ply']


@pytest.mark.parametrize('error', [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / 'map.ply'
    path.write_bytes(b'old')
    with pytest.raises(error, match='stop'):
        write(path, b'new', then=error('stop'))
    assert path.read_bytes() == b'old'
    assert os.listdir(tmp_path) == ['map.ply']


def test_a_symbolic_link_stays_and_leads_to_the_new_file(tmp_path):
    (tmp_path / 'disk').mkdir()
    path = tmp_path / 'map.ply'
    path.symlink_to(tmp_path / 'disk' / 'map.ply')
    with replace_file(path) as file:
        file.write(b'new')
    assert path.is_symlink()
    assert (tmp_path / 'disk' / 'map.ply').read_bytes() == b'new'


@pytest.mark.parametrize(('umask', 'mode'), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_permissions_follow_the_umask(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        write(tmp_path / 'map.ply')
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / 'map.ply').stat().st_mode) == mode


def test_a_missing_directory_is_named(tmp_path):
    path = tmp_path / 'absent' / 'map.ply'
    with pytest.raises(FileFormatError, match=r'absent/map\.ply: cannot be written: No such'):
        write(path)


def test_a_name_too_long_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(FileFormatError, match='cannot be written: File name too long'):
        write(tmp_path / ('m' * 300))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize('path', ['.', '', os.devnull])
def test_only_regular_files_are_replaced(tmp_path, monkeypatch, path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileFormatError, match='not a regular file'):
        write(path)
    assert os.listdir(tmp_path) == []


@contextmanager
def small_disk(directory, size):
    """Mount a disk of ``size`` bytes, or skip the test if that is not allowed."""
    if shutil.which('mount') is None or not sys.platform.startswith('linux'):
        pytest.skip('needs mount of Linux')
    options = ['-t', 'tmpfs', '-o', f'size={size}', 'tmpfs', str(directory)]
    if subprocess.run(['mount', *options], capture_output=True).returncode:
        pytest.skip('not allowed to mount a small disk')
    try:
        yield
    finally:
        subprocess.run(['umount', str(directory)], check=True)


@pytest.mark.parametrize('chunk', [100, 2**20], ids=['buffered', 'at once'])
def test_a_full_disk_leaves_the_old_file_and_is_named(tmp_path, chunk):
    with small_disk(tmp_path, 65536):
        path = tmp_path / 'map.ply'
        path.write_bytes(b'old')
        with pytest.raises(FileFormatError, match=r'map\.ply: cannot be written: No space left'):
            write(path, *[bytes(chunk)] * (2**20 // chunk))
        assert path.read_bytes() == b'old'
        assert os.listdir(tmp_path) == ['map.ply']


def test_a_full_device_is_noticed_at_the_last_flush(tmp_path):
    with small_disk(tmp_path, 4096):
        (tmp_path / 'other').write_bytes(bytes(4096))
        with pytest.raises(FileFormatError, match='No space left'):
            write(tmp_path / 'map.ply', b'few')
        assert os.listdir(tmp_path) == ['other']


def test_a_directory_is_made_with_its_parents_or_the_file_in_its_place_is_named(tmp_path):
    make_directory(tmp_path / 'a' / 'b')
    make_directory(tmp_path / 'a' / 'b')
    assert (tmp_path / 'a' / 'b').is_dir()
    (tmp_path / 'file').write_bytes(b'')
    (tmp_path / 'link').symlink_to('nowhere')
    for name, below in (('file', ''), ('file', 'a'), ('link', '')):
        path = tmp_path / name / below
        said = f'{path}: {tmp_path / name} is a file, expected a directory'
        with pytest.raises(FileFormatError, match=f'^{said}$'):
            make_directory(path)


def test_numbers_that_json_lacks_become_none_at_any_depth():
    content = {'a': math.nan, 'b': [1.5, -math.inf, ('x', math.inf, 2, True, None)]}
    found = finite_or_none({'c': content})
    assert found == {'c': {'a': None, 'b': [1.5, None, ('x', None, 2, True, None)]}}


def test_json_with_nan_is_refused_and_leaves_the_old_file(tmp_path):
    path = tmp_path / 'summary.json'
    path.write_text('old')
    with pytest.raises(ValueError, match='not JSON compliant'):
        write_json(path, {'drift': math.nan})
    assert path.read_text() == 'old'


def test_files_of_dead_processes_are_removed_and_those_in_use_stay(tmp_path):
    names = ['.surfel_mapper-dead.part', 'other.part', '.surfel_mapper-dead.npz']
    for name in names:
        (tmp_path / name).write_bytes(b'')
    (tmp_path / '.surfel_mapper-link.part').symlink_to(tmp_path / 'other.part')

    with replace_file(tmp_path / 'map.npz') as file:
        file.write(b'a map')
        assert remove_abandoned(tmp_path) == [tmp_path / names[0]]

    assert (tmp_path / 'map.npz').read_bytes() == b'a map'
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        [*names[1:], '.surfel_mapper-link.part', 'map.npz']
    )
    assert remove_abandoned(tmp_path / 'nowhere') == []


@pytest.mark.parametrize('error', [None, KeyboardInterrupt])
def test_a_directory_is_replaced_as_a_whole_or_not_at_all(tmp_path, error):
    path = tmp_path / 'map'
    path.mkdir()
    (path / 'old').write_bytes(b'')

    with (
        nullcontext() if error is None else pytest.raises(error),
        replace_directory(path) as fresh,
    ):
        (fresh / 'below').mkdir(parents=True)
        (fresh / 'below' / 'new').write_bytes(b'')
        assert os.listdir(path) == ['old']
        if error is not None:
            raise error

    assert os.listdir(path) == ['below' if error is None else 'old']
    assert os.listdir(tmp_path) == ['map']
