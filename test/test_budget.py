# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Budgets refuse before memory is allocated; only regular files of limited size are read."""

import logging
import os
import stat

import pytest

from surfel_mapper.budget import (
    Budget,
    BYTES_PER_BYTE,
    FLOOR_BYTES,
    read_small_file,
    VARIABLE,
)
from surfel_mapper.errors import (
    BagError,
    CloudFormatError,
    ConfigError,
    counted,
    LineFormatter,
    one_line,
)
from surfel_mapper.memory import machine_bytes


def test_small_inputs_may_use_the_floor_and_large_ones_a_multiple_of_their_size():
    assert Budget('a', 10, BagError).max_bytes == FLOOR_BYTES
    assert Budget('a', FLOOR_BYTES, BagError).max_bytes == BYTES_PER_BYTE * FLOOR_BYTES


def test_the_error_of_the_reader_names_input_need_and_limit(monkeypatch):
    monkeypatch.setenv(VARIABLE, '1000')
    budget = Budget('/points', 10, CloudFormatError)
    budget.take(600, 'fields')
    with pytest.raises(
        CloudFormatError, match=r'/points: data: needs 1100 bytes, .* limit of 1000 .*MAX'
    ):
        budget.take(500, 'data')
    budget.take(400, 'data')
    assert budget.used_bytes == 1000


def test_a_variable_sets_the_upper_bound(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    assert Budget('a', 10**18, BagError).max_bytes == machine_bytes() * 3 // 4 > FLOOR_BYTES
    monkeypatch.setenv(VARIABLE, '5000')
    assert Budget('a', 10, BagError).max_bytes == 5000
    for text in ('0', '00', '-1', '1e9', 'all', '4G', '9' * 19, '9' * 5000):
        monkeypatch.setenv(VARIABLE, text)
        says = f'{VARIABLE}: {text!r}, expected a positive number of bytes, such as 4294967296'
        with pytest.raises(ConfigError) as raised:
            Budget('a', 10, BagError)
        assert str(raised.value) == one_line(says)
    assert issubclass(ConfigError, ValueError)


def test_only_regular_files_of_limited_size_are_read(tmp_path):
    path = tmp_path / 'a.yaml'
    path.write_bytes(b'x' * 100)
    assert read_small_file(path, 100) == b'x' * 100
    with pytest.raises(ValueError, match='larger than 99'):
        read_small_file(path, 99)
    os.mkfifo(tmp_path / 'pipe')
    for other in ('/dev/zero', tmp_path / 'pipe'):
        with pytest.raises(ValueError, match='not a regular file'):
            read_small_file(other)
    with pytest.raises(IsADirectoryError):
        read_small_file(tmp_path)


def test_a_log_of_the_kernel_which_waits_like_a_pipe_is_not_read(tmp_path, monkeypatch):
    """The file /proc/kmsg is regular, and at its end a read returns None."""
    os.mkfifo(tmp_path / 'log')
    writer = os.open(tmp_path / 'log', os.O_RDWR | os.O_NONBLOCK)
    monkeypatch.setattr(stat, 'S_ISREG', lambda mode: True)
    with pytest.raises(ValueError, match='not a regular file'):
        read_small_file(tmp_path / 'log')
    os.close(writer)


def test_messages_are_one_line_without_control_characters():
    assert str(BagError('a\nb\x1b[31m')) == 'a\\nb\\x1b[31m'
    assert one_line('größe 5 µs') == 'größe 5 µs'
    assert one_line('a\u2028b\u202ec\ud800') == 'a\\u2028b\\u202ec\\ud800'


def test_log_lines_are_one_line_and_tracebacks_stay():
    record = logging.LogRecord('a', logging.WARNING, '', 0, '%s', ('x\n[ERROR] forged',), None)
    assert LineFormatter('%(message)s').format(record) == 'x\\n[ERROR] forged'
    record.exc_text = 'Traceback\n  line'
    assert LineFormatter('%(message)s').format(record).splitlines()[1:] == ['Traceback', '  line']


def test_a_number_of_one_has_its_noun_in_the_singular():
    texts = [counted(number, 'surfel') for number in (0, 1, 2, 12345)]
    assert texts == ['0 surfels', '1 surfel', '2 surfels', '12,345 surfels']
