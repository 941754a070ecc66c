# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Saved states come back equal, or are refused: damage at any byte, other versions."""

import hashlib
import io
import json
import os
import zipfile

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.state import load_state, save_state


def make_arrays():
    rng = np.random.default_rng(1)
    return {
        'key': rng.integers(-(2**62), 2**62, 100),
        'product': rng.integers(-(2**40), 2**40, (100, 6)),
        'turned': np.arange(12.0).reshape(3, 4).T,
        'flags': rng.integers(0, 2, 10).astype(bool),
        'big_endian': np.arange(5, dtype='>u2'),
        'empty': np.empty((0, 3), np.float32),
        'scalar': np.array(1.5),
        'not-a.number': np.array([np.nan, np.inf, -0.0]),
    }


ATTRIBUTES = {'voxel_size_m': 0.1, 'digest': 'ab', 'nested': {'list': [1, None, True, 'ü']}}


def assert_equal_arrays(found, expected):
    assert list(found) == list(expected)
    for name, array in expected.items():
        assert found[name].dtype == array.dtype
        assert found[name].shape == array.shape
        assert found[name].tobytes() == array.tobytes()


@pytest.mark.parametrize('compress', [False, True])
def test_arrays_and_attributes_come_back_equal(tmp_path, compress):
    path = tmp_path / 'map.npz'
    save_state(path, make_arrays(), ATTRIBUTES, compress=compress)
    arrays, attributes = load_state(path)
    assert_equal_arrays(arrays, make_arrays())
    assert attributes == ATTRIBUTES
    arrays['key'][0] = 1  # they are the caller's own


def test_an_empty_state_comes_back(tmp_path):
    save_state(tmp_path / 'map.npz', {}, {})
    assert load_state(tmp_path / 'map.npz') == ({}, {})


def test_equal_content_gives_equal_bytes(tmp_path):
    for name in 'ab':
        save_state(tmp_path / name, make_arrays(), ATTRIBUTES)
    assert (tmp_path / 'a').read_bytes() == (tmp_path / 'b').read_bytes()


def test_compression_makes_files_smaller(tmp_path):
    arrays = {'a': np.arange(10_000)}
    save_state(tmp_path / 'plain', arrays, {})
    save_state(tmp_path / 'packed', arrays, {}, compress=True)
    assert os.path.getsize(tmp_path / 'packed') < 0.5 * os.path.getsize(tmp_path / 'plain')


def test_numpy_reads_the_arrays_alone(tmp_path):
    arrays = make_arrays()
    save_state(tmp_path / 'map.npz', arrays, ATTRIBUTES)
    with np.load(tmp_path / 'map.npz', allow_pickle=False) as archive:
        for name, array in arrays.items():
            np.testing.assert_array_equal(archive[name], array)


@pytest.mark.parametrize('value', [np.int64(1), {1, 2}, float('nan')])
def test_attributes_that_are_not_json_are_refused(tmp_path, value):
    with pytest.raises((TypeError, ValueError)):
        save_state(tmp_path / 'map.npz', {}, {'a': value})
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize('compress', [False, True])
def test_a_flipped_byte_is_refused_or_changes_nothing(tmp_path, compress):
    path, arrays = tmp_path / 'map.npz', {'key': np.arange(20) ** 5, 'n': np.arange(3.0)}
    save_state(path, arrays, ATTRIBUTES, compress=compress)
    content = path.read_bytes()
    refused = 0
    for place in range(len(content)):
        for bits in (0x01, 0xFF):
            damaged = bytearray(content)
            damaged[place] ^= bits
            path.write_bytes(damaged)
            try:
                found, attributes = load_state(path)
            except FileFormatError:
                refused += 1
                continue
            assert_equal_arrays(found, arrays)  # dates and the like of the archive
            assert attributes == ATTRIBUTES
    assert refused > len(content)


@pytest.mark.parametrize('compress', [False, True])
def test_a_truncated_file_is_refused_at_any_length(tmp_path, compress):
    path = tmp_path / 'map.npz'
    save_state(path, {'key': np.arange(50)}, {}, compress=compress)
    content = path.read_bytes()
    for length in range(len(content)):
        path.write_bytes(content[:length])
        with pytest.raises(FileFormatError, match=r'map\.npz: '):
            load_state(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileFormatError, match=r'absent\.npz: cannot be read: No such file'):
        load_state(tmp_path / 'absent.npz')


def test_an_npz_of_something_else_is_refused(tmp_path):
    np.savez(tmp_path / 'other.npz', a=np.zeros(3))
    with pytest.raises(FileFormatError, match=r'no manifest\.json inside, expected a state'):
        load_state(tmp_path / 'other.npz')


def forge(path, changes, members=(), compression=zipfile.ZIP_STORED):
    """Write a state by hand, its hash right, with changes to the manifest or the members."""
    array = np.arange(4, dtype='<i8')
    npy = io.BytesIO()
    np.save(npy, array)
    files = {'a.npy': npy.getvalue(), **dict(members)}
    manifest = {
        'format': 'surfel_mapper state',
        'version': 1,
        'attributes': {},
        'arrays': [{'name': 'a', 'dtype': '<i8', 'shape': [4]}],
        **changes,
    }
    text = json.dumps(manifest, sort_keys=True).encode()
    manifest.setdefault('sha256', hashlib.sha256(text + array.tobytes()).hexdigest())
    with zipfile.ZipFile(path, 'w', compression) as archive:
        archive.writestr('manifest.json', json.dumps(manifest))
        for name, content in files.items():
            archive.writestr(name, content)


def test_a_state_written_by_hand_is_read(tmp_path):
    forge(tmp_path / 'map.npz', {})
    arrays, _ = load_state(tmp_path / 'map.npz')
    assert_equal_arrays(arrays, {'a': np.arange(4, dtype='<i8')})


def npy(array):
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


@pytest.mark.parametrize(
    ('changes', 'members', 'expected'),
    [
        ({'version': 2}, {}, "version 2, expected 'surfel_mapper state', version 1"),
        ({'format': 'other'}, {}, "format 'other'"),
        ({'sha256': '00'}, {}, 'damaged: content has sha256 .* expected 00'),
        ({'attributes': [1]}, {}, 'damaged'),
        ({'arrays': []}, {}, '1 unknown members'),
        ({'arrays': [{'name': 'b', 'dtype': '<i8', 'shape': [4]}]}, {}, 'damaged'),
        ({'arrays': [{'name': 'a', 'dtype': '<f8', 'shape': [4]}]}, {}, 'damaged'),
        ({'arrays': [{'name': 'a', 'dtype': '|O', 'shape': [4]}]}, {}, 'damaged'),
        ({}, {'b.npy': npy(np.zeros(3))}, '1 unknown members'),
        ({}, {'a.npy': b'no array'}, 'damaged'),
        ({}, {'a.npy': npy(np.arange(4))[:-1]}, 'damaged'),
        ({}, {'a.npy': npy(np.arange(4)).replace(b'(4,)', b'(9,)')}, 'damaged'),
    ],
)
def test_a_forged_state_is_refused(tmp_path, changes, members, expected):
    forge(tmp_path / 'map.npz', changes, members)
    with pytest.raises(FileFormatError, match=rf'map\.npz: .*{expected}'):
        load_state(tmp_path / 'map.npz')
