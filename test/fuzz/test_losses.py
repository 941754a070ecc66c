# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
No silent loss: a valid bag with one change gives as many messages, or the loss is told.

A bit is flipped, every seventh byte of a stretch is zeroed, or the file is cut, at places spread
over it. Reading may then fail with our own error, warn, or give as many messages: without
checksums a changed number cannot be told from a true one.
"""

from __future__ import annotations

import logging
import random

import pytest

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.errors import SurfelMapperError
from test.fuzz import corpus

NUM_CHANGES = 120


def changes(content, number=NUM_CHANGES, seed=4):
    """Yield a file with one bit changed, with zeros in a stretch of it, or cut off."""
    rng = random.Random(seed)
    for row in range(number):
        at = len(content) * row // number + rng.randrange(max(len(content) // number, 1))
        at = min(at, len(content) - 1)
        if row % 8 == 1:
            changed = bytearray(content)
            places = range(at, min(at + 1000, len(content)), 7)
            changed[at : places.stop : 7] = bytes(len(places))
            yield at, bytes(changed)
        elif row % 4:
            changed = bytearray(content)
            changed[at] ^= 1 << rng.randrange(8)
            yield at, bytes(changed)
        else:
            yield at, content[:at]


def bag_content(path):
    """Return topic, type, time and bytes of every message."""
    with BagReader(path) as reader:
        return [(m.topic, m.type, m.record_ns, bytes(m.raw)) for m in reader.messages()]


def outline_of_bag(path):
    """Return topic, type and size of the messages of a bag, sorted."""
    return sorted((topic, type_, len(raw)) for topic, type_, _, raw in bag_content(path))


OUTLINES = {
    'plain.mcap': (lambda: corpus.rosbag2('mcap')[0], outline_of_bag),
    'plain.bag': (lambda: corpus.ros1()[0], outline_of_bag),
    'plain.db3': (lambda: corpus.sqlite()[0], outline_of_bag),
}


@pytest.mark.parametrize('name', OUTLINES)
def test_a_change_in_a_bag_without_checksums_loses_no_message_in_silence(tmp_path, caplog, name):
    make, read = OUTLINES[name]
    content, path = make(), tmp_path / name
    path.write_bytes(content)
    expected = read(path)
    silent = []
    for at, changed in changes(content):
        path.write_bytes(changed)
        if not same_or_told(path, read, caplog, lambda found: len(found) == len(expected)):
            silent.append(at)
    assert silent == []


def same_or_told(path, read, caplog, is_same):
    """Return whether reading fails with our error, warns, or gives the same content."""
    caplog.clear()
    try:
        found = read(path)
    except SurfelMapperError:
        return True
    warned = any(record.levelno >= logging.WARNING for record in caplog.records)
    return warned or is_same(found)
