# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables in text are read in steps of a piece, not of a line, and errors still name the line."""

from fractions import Fraction
import random
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfel_mapper.budget import Budget
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.pose_rows import EXACT_SKEW, MAX_SKEW, rigid_poses
from surfel_mapper.files.stamps import nanoseconds, read_dates, read_times
from surfel_mapper.files.text_lines import num_decimals, read_lines, table_rows
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.offline.datasets import find_dataset
from test.offline import dataset_folders

LINES = 40_000


def steps_of(function):
    """Return the result of a function, and the number of calls that Python makes for it."""
    number = 0

    def count(frame, event, argument):
        nonlocal number
        number += event in ('call', 'c_call')

    sys.setprofile(count)
    try:
        result = function()
    finally:
        sys.setprofile(None)
    return result, number


def helipr(path):
    folder, _, _ = dataset_folders.helipr(path.parent)
    path.rename(folder / 'LiDAR_GT' / 'Ouster_gt.txt')
    return find_dataset(folder).trajectory


def mulran(path):
    folder, _, _ = dataset_folders.mulran(path.parent)
    path.rename(folder / 'global_pose.csv')
    return find_dataset(folder).trajectory


TUM, HEADER = '{0} 0 0 0 0 0 0 1\n', 't,x,y,z,qx,qy,qz,qw\n'

LONG = {
    'tum': (read_trajectory, '', TUM),
    'tum with an exponent': (read_trajectory, '', '{0}e0 0 0 0 0 0 0 1\n'),
    'tum with 25 digits': (read_trajectory, '', '{0}.{0:020} 0 0 0 0 0 0 1\n'),
    'kitti': (read_trajectory, '', '1 0 0 0 0 1 0 0 0 0 1 0\n'),
    'kitti of three digits': (read_trajectory, '', '1 0 0 0 0 1 0 0 0 0 .9995 0\n'),
    'csv': (read_trajectory, HEADER, '{0},0,0,0,0,0,0,1\n'),
    'csv with spaces': (read_trajectory, HEADER, '{0}, 0, 0, 0, 0, 0, 0, 1\n'),
    'times': (read_times, '', '{0}\n'),
    'times of KITTI': (read_times, '', '{0:e}\n'),
    'dates': (read_dates, '', '2011-09-26 13:02:25.594360375\n'),
    'HeLiPR': (helipr, '', '{0} 0 0 0 0 0 0 1\n'),
    'MulRan': (mulran, '', '{0},1,0,0,0,0,1,0,0,0,0,1,0\n'),
}


@pytest.mark.parametrize(('read', 'head', 'line'), LONG.values(), ids=LONG)
def test_a_long_table_takes_no_step_of_python_a_line(tmp_path, read, head, line):
    """A pose of 24 bytes took 60 calls and 50 us; a date, or a stamp with spaces, takes two."""
    path = tmp_path / 'table.txt'
    path.write_text(head + ''.join(map(line.format, range(LINES))))
    found, steps = steps_of(lambda: read(path))
    assert len(found) == LINES
    assert steps < 3 * LINES


@pytest.mark.parametrize('line', ['', ' ', '#', '# a comment of poses', '%'])
def test_lines_that_say_nothing_take_no_step_of_python(tmp_path, line):
    path = tmp_path / 'poses.txt'
    path.write_text('1.5 1 2 3 0 0 0 1\n' + f'{line}\n' * LINES + '2.5 1 2 3 0 0 0 1\n')
    found, steps = steps_of(lambda: read_trajectory(path))
    assert found.stamp_ns.tolist() == [1_500_000_000, 2_500_000_000]
    assert steps < LINES
    path.write_text('1.5 1 2 3 0 0 0 1\n' + f'{line}\n' * LINES + '2.5 1 2 3\n')
    with pytest.raises(FileFormatError, match=rf'poses\.txt:{LINES + 2}: 4 columns, expected 8'):
        read_trajectory(path)


@pytest.mark.parametrize(
    ('kind', 'problem'),
    [
        ('{0} 0 0 0 0 0 1', '7 columns, expected 8: stamp x y z q'),
        ('{0} 0 0 x 0 0 0 1', "could not convert string to float: 'x', expected a number"),
        ('{0} 0 0 1_0 0 0 0 1', "'1_0' is no number, expected a number"),
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
            is_comment = line.strip()[:1] in ('#', '%') and ',' not in line
            if line.strip() and not is_comment:
                expected.append((number, line))
        found = []
        for lines in read_lines(path, Budget.of_file(path, FileFormatError)):
            texts = lines.text.decode().split('\n')[:-1]
            found += zip(lines.numbers.tolist(), texts, strict=True)
        assert found == expected, text


def test_decimals_are_those_of_the_last_number():
    text = b'1 2.25\n 3.5 4 \n5,6.125\n7.5,\n0.1 1.5e-03\n,\n8.\n'
    assert num_decimals(text).tolist() == [2, 0, 3, 1, 5, 0, 0]


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


@pytest.mark.parametrize('word', ['7E+1\x1c', '\x1f5', '1e999999999', '-1e999999999', 'nan'])
def test_times_with_separators_of_ascii_or_of_no_size_are_refused(tmp_path, word):
    """Decimal takes separators for spaces: 7E+1 with one was read by itself, a line at a time."""
    path = tmp_path / 'times.txt'
    path.write_text(f'1\n{word}\n')
    with pytest.raises(FileFormatError, match=r'times\.txt:2: '):
        read_times(path)


@pytest.mark.parametrize(
    'line',
    ['2011-13-26 13:02:25', '2011-09-26 13:02:25.x', '11-09-26 13:02:25', '1969-12-31 0:0:0'],
)
def test_dates_of_another_form_are_refused_with_their_line(tmp_path, line):
    path = tmp_path / 'timestamps.txt'
    path.write_text(f'2011-09-26 13:02:25.5\n\n{line}\n')
    with pytest.raises(FileFormatError, match=rf"timestamps\.txt:3: '{line}' is no time"):
        read_dates(path)


CUT = {
    'tum': (read_trajectory, '{0}.5 0 0 0 0 0 0 1.000000\n'),
    'kitti': (read_trajectory, '1 0 0 0.25 0 1 0 0.5 0 0 1 0.125000\n'),
    'times': (read_times, '{0}.250000\n'),
    'dates': (read_dates, '2011-09-26 13:02:25.594360375\n'),
    'HeLiPR': (helipr, '{0} 0 0 0 0 0 0 1.000000\n'),
    'MulRan': (mulran, '{0},1,0,0,0,0,1,0,0,0,0,1,0.500000\n'),
}


@pytest.mark.parametrize(('read', 'line'), CUT.values(), ids=CUT)
def test_a_last_number_that_is_cut_is_refused_in_every_table(tmp_path, caplog, read, line):
    whole = ''.join(line.format(row) for row in range(1, 5))
    for length in range(1, 7):
        path = tmp_path / str(length) / 'table.txt'
        path.parent.mkdir()
        path.write_text(whole[:-length])
        if length == 1:  # as editors and scripts leave it
            assert len(read(path)) == 4
            assert ':4: the last line has no end; is the file cut off there?' in caplog.text
            continue
        with pytest.raises(FileFormatError, match=':4: no end of line after the last number'):
            read(path)


def test_numbers_of_many_lengths_tell_a_shorter_one_after_a_hundred(tmp_path, caplog):
    path = tmp_path / 'times.txt'
    for number, is_refused in ((90, False), (200, True)):
        words = [f'{row}.{"25" * (1 + row % 3)}' for row in range(number)]
        path.write_text('\n'.join([*words, f'{number}.2']))
        if is_refused:
            with pytest.raises(FileFormatError, match=f':{number + 1}: no end of line'):
                read_times(path)
        else:
            assert len(read_times(path)) == number + 1
        path.write_text('\n'.join([*words, f'{number}.25']))
        assert len(read_times(path)) == number + 1
    assert caplog.text.count('the last line has no end') == 3


@pytest.mark.parametrize('last', ['0', '0.5'])
def test_whole_numbers_among_decimals_refuse_no_last_one(tmp_path, last):
    path = tmp_path / 'poses.txt'
    numbers = ['0', *['0.500'] * 300, last]
    path.write_text('\n'.join(f'1 0 0 0 0 1 0 0 0 0 1 {number}' for number in numbers))
    assert len(read_trajectory(path)) == 302


@pytest.mark.parametrize('write', [ply, pcd])
def test_points_of_one_digit_are_read_by_remembered_words(tmp_path, write):
    """A number of one digit took 170 ns to read, and a file has one for each two bytes."""
    points = np.random.default_rng(1).integers(0, 9, (20_000, 3))
    path = tmp_path / f'a.{write.__name__.rpartition(".")[2]}'
    rows = '\n'.join(' '.join(map(str, row)) for row in points.tolist()) + '\n'
    path.write_text(HEADS[path.suffix].format(len(points)) + rows)
    columns = write.read_points(path)
    np.testing.assert_array_equal(np.stack([columns[axis] for axis in 'xyz'], axis=1), points)


HEADS = {
    '.ply': 'ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty double y\n'
    'property uchar z\nend_header\n',
    '.pcd': 'VERSION 0.7\nFIELDS x y z\nSIZE 4 8 1\nTYPE F I U\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\n'
    'POINTS {0}\nDATA ascii\n',
}


def test_rows_of_a_table_name_their_lines(tmp_path):
    path = tmp_path / 'a.txt'
    path.write_text('# b\n1 2\n\n3 4\n')
    budget = Budget.of_file(path, FileFormatError)
    (rows,) = table_rows(read_lines(path, budget), 2, budget)
    assert rows.numbers([1, 0]).tolist() == [[2.0, 1.0], [4.0, 3.0]]
    assert [rows.lines.where(row) for row in range(2)] == [f'{path}:2', f'{path}:4']


@pytest.mark.parametrize('off', [1e-6, 1e-4, 9e-4])
def test_the_nearest_rotation_is_the_polar_factor(off):
    rng = np.random.default_rng(5)
    exact = Rotation.random(500, random_state=5).as_matrix()
    given = exact + rng.uniform(-off, off, exact.shape) / 2.0
    numbers = np.concatenate([given, rng.normal(size=(500, 3, 1))], axis=2).reshape(-1, 12)
    poses, skew = rigid_poses(numbers)
    np.testing.assert_allclose(
        skew, np.abs(given @ given.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)), atol=1e-15
    )
    left, _, right = np.linalg.svd(given)
    expected = np.where((skew <= EXACT_SKEW)[:, None, None], given, left @ right)
    assert (skew <= MAX_SKEW).all()
    # LAPACK is 5e-15 off, these are orthonormal to 5e-16
    np.testing.assert_allclose(poses[:, :3, :3], expected, rtol=0, atol=2e-14)
    np.testing.assert_array_equal(poses[:, :3, 3], numbers[:, 3::4])
    np.testing.assert_array_equal(poses[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (500, 1)))


@pytest.mark.parametrize('odd', [np.nan, np.inf, 3.0, -1.0])
def test_matrices_that_are_no_rotation_have_no_skew(odd):
    numbers = np.eye(4)[:3].ravel()
    numbers[10] = odd
    assert rigid_poses(numbers[None])[1] == np.inf
