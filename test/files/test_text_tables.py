# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables in text are read to the last digit, and errors name the line."""

from fractions import Fraction
import random

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files import pcd, ply, text_table
from surfel_mapper.files.pose_rows import rigid_poses
from surfel_mapper.files.stamps import nanoseconds, read_dates, read_times
from surfel_mapper.files.text_table import read_lines, table_rows
from surfel_mapper.files.trajectory import read_trajectory

TUM = '{0} 0 0 0 0 0 0 1\n'


@pytest.mark.parametrize(
    ('kind', 'problem'),
    [
        ('{0} 0 0 0 0 0 1', '7 columns, expected 8: stamp x y z q'),
        ('{0} 0 0 x 0 0 0 1', "could not convert string to float: 'x', expected a number"),
        ('{0} 0 0 inf 0 0 0 1', '0, 0, inf, 0, 0, 0, 1: not all are finite'),
        ('{0} 0 0 0 0 0 0 2', r'quaternion \[0.0, 0.0, 0.0, 2.0\] has norm 2, expected 1'),
        ('noon 0 0 0 0 0 0 1', "'noon' is no time"),
        ('1 0 0 0 0 0 0 1', 'stamp is not after that of the pose before'),
    ],
)
def test_one_wrong_line_among_thousands_is_named(tmp_path, kind, problem):
    lines = [TUM.format(row) for row in range(5000)]
    for row in (0, 1, 2500, 4999):
        if row < 2 and kind.startswith('1 '):
            continue
        changed = [*lines]
        changed[row] = kind.format(row) + '\n'
        path = tmp_path / 'poses.txt'
        path.write_text('# a comment\n\n' + ''.join(changed))
        with pytest.raises(FileFormatError, match=rf'poses\.txt:{row + 3}: .*{problem}'):
            read_trajectory(path, 'tum')


def test_lines_are_those_of_a_loop_over_them(tmp_path):
    rng = random.Random(1)
    pieces = ('1', '22.5', ' ', '\t', '#', '%', ',', '\n', '\n', '\r\n', '\r', '-3', 'a b\n', 'é')
    for _ in range(200):
        text = ''.join(rng.choices(pieces, k=rng.choice((3, 30, 300))))
        path = tmp_path / 'a.txt'
        path.write_bytes(text.encode())
        expected = []
        for number, line in enumerate(
            text.replace('\r\n', '\n').replace('\r', '\n').split('\n'), 1
        ):
            is_comment = line.strip()[:1] in ('#', '%')
            if line.strip() and not is_comment:
                expected.append((number, line))
        lines = read_lines(path)
        assert [*zip(lines.numbers, lines.texts, strict=True)] == expected, text


def exact_ns(word, unit_ns):
    """Return a time in ns by rational arithmetic, half to even; None if it is none."""
    try:
        value = Fraction(word) * unit_ns
    except (ValueError, ZeroDivisionError):
        return None
    stamp_ns = round(value)
    return stamp_ns if 0 <= stamp_ns < 2**63 else None


def some_time(rng):
    if rng.random() < 0.1:
        return ''.join(rng.choices('0123456789.eE+-n', k=rng.randrange(1, 6)))
    whole = str(rng.randrange(10 ** rng.randrange(1, 13)))
    rest = ''.join(rng.choices('00005999123', k=rng.choice((0, 1, 9, 10, 12, 19, 30))))
    tie = rest[:9].ljust(9, '3') + '5' + '0' * rng.randrange(9) + rng.choice(('', '1'))
    text = f'{rng.choice(("", "+"))}{whole}.{rng.choice((rest, tie))}'
    return text + rng.choice(('', '', f'e{rng.randrange(-30, 5)}', f'E+{rng.randrange(3)}'))


def test_times_of_a_table_are_exact_to_the_last_nanosecond(tmp_path):
    rng, path = random.Random(2), tmp_path / 'times.txt'
    words = [some_time(rng) for _ in range(20_000)]
    known = [(word, exact_ns(word, 10**9)) for word in words]
    path.write_text(''.join(f'{word}\n' for word, stamp_ns in known if stamp_ns is not None))
    expected = [stamp_ns for _, stamp_ns in known if stamp_ns is not None]
    assert len(expected) > 10_000
    assert read_times(path).tolist() == expected
    for word in [word for word, stamp_ns in known if stamp_ns is None][:300]:
        path.write_text(f'1\n{word}\n')
        with pytest.raises(FileFormatError, match=r'times\.txt:2: '):
            read_times(path)
        with pytest.raises(FileFormatError):
            nanoseconds(word, 'a')


@pytest.mark.parametrize(
    'line',
    [
        '2011-13-26 13:02:25',
        '2011-09-26 13:02:25.x',
        '2011-09-26 13:02:25-02:00',
        '11-09-26 13:02:25',
        '1969-12-31 0:0:0',
        '9999-09-26 13:02:25',
    ],
)
def test_dates_of_another_form_are_refused_with_their_line(tmp_path, line):
    path = tmp_path / 'timestamps.txt'
    path.write_text(f'2011-09-26 13:02:25.5Z\n\n{line}\n')
    with pytest.raises(FileFormatError, match=rf"timestamps\.txt:3: '{line}' is no time"):
        read_dates(path)


HEADS = {
    '.ply': 'ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty double y\n'
    'property uchar z\nend_header\n',
    '.pcd': 'VERSION 0.7\nFIELDS x y z\nSIZE 4 8 1\nTYPE F I U\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\n'
    'POINTS {0}\nDATA ascii\n',
}


@pytest.mark.parametrize(('suffix', 'module'), [('.ply', ply), ('.pcd', pcd)])
def test_points_in_text_are_read_into_columns_of_their_types(tmp_path, suffix, module):
    path = tmp_path / f'a{suffix}'
    path.write_text(HEADS[suffix].format(2) + '0.1 20 255\n-1e3  -3 0')  # no end of the last line
    columns = module.read_points(path)
    np.testing.assert_array_equal(columns['x'], np.float32([0.1, -1000.0]))
    np.testing.assert_array_equal(columns['y'], [20, -3])
    np.testing.assert_array_equal(columns['z'], np.uint8([255, 0]))


def test_stamps_of_points_in_text_keep_all_digits(tmp_path):
    path = tmp_path / 'a.pcd'
    path.write_text(
        'VERSION 0.7\nFIELDS x y z t\nSIZE 4 4 4 8\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 1\n'
        'HEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3 1700000000123456789\n'
    )
    assert pcd.read_points(path)['t'].tolist() == [1_700_000_000_123_456_789]


@pytest.mark.parametrize('end', ['', '\n', '\r\n'])
def test_the_last_line_needs_no_end(tmp_path, end):
    path = tmp_path / 'poses.tum'
    path.write_text('1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1.0' + end)
    assert len(read_trajectory(path)) == 2


def test_a_table_over_the_limit_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(text_table, 'MAX_TEXT_BYTES', 10)
    path = tmp_path / 'poses.tum'
    path.write_text('1 0 0 0 0 0 0 1\n')
    with pytest.raises(FileFormatError, match=r'poses\.tum: cannot be read: larger than 10 bytes'):
        read_trajectory(path)


def test_rows_of_a_table_name_their_lines(tmp_path):
    path = tmp_path / 'a.txt'
    path.write_text('# b\n1 2\n\n3 4\n')
    rows = table_rows(read_lines(path), 2)
    assert rows.numbers([1, 0]).tolist() == [[2.0, 1.0], [4.0, 3.0]]
    assert [rows.lines.where(row) for row in range(2)] == [f'{path}:2', f'{path}:4']


@pytest.mark.parametrize('odd', [np.nan, np.inf, 3.0, -1.0])
def test_matrices_that_are_no_rotation_have_no_skew(odd):
    numbers = np.eye(4)[:3].ravel()
    numbers[10] = odd
    assert rigid_poses(numbers[None])[1] == np.inf
