# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Captures that end or stall ouster-sdk are refused before it reads them."""

from __future__ import annotations

import json
import os
import struct

import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.offline.pcap_packets import check_capture, LEAST_BYTES, MAX_PACKETS, MAX_PENDING

ETHERNET, LINUX = 1, 113
METADATA = {'data_format': {'pixels_per_column': 128, 'columns_per_frame': 1024}}


def capture(*packets, link=ETHERNET, order='<', magic=0xA1B2C3D4):
    head = struct.pack(f'{order}IHHIIII', magic, 2, 4, 0, 0, 65535, link)
    records = (struct.pack(f'{order}4I', 5, 0, len(p), len(p)) + p for p in packets)
    return head + b''.join(records)


def ethernet(content, protocol=0x0800):
    return bytes(12) + struct.pack('>H', protocol) + content


def ipv4(content, *, protocol=17, number=1, flags=0, total=None, words=5):
    total = 20 + len(content) if total is None else total
    return (
        struct.pack('>BBHHHBBH8x', 0x40 | words, 0, total, number, flags, 9, protocol, 0) + content
    )


def udp(content, size=None):
    return (
        struct.pack('>HHHH', 7502, 7502, 8 + len(content) if size is None else size, 0) + content
    )


GOOD = ethernet(ipv4(udp(b'abc')))
EMPTY = ethernet(ipv4(udp(b'')))
MORE, ELSE = 0x2000, 1  # flags of a first fragment, and of a last one at byte 8


def read(tmp_path, content, metadata=METADATA):
    path = tmp_path / 'a.pcap'
    path.write_bytes(content)
    (tmp_path / 'a.json').write_text(json.dumps(metadata))
    check_capture(path)


READ = {
    'one': capture(GOOD),
    'nothing': capture(),
    'cut': capture(GOOD, GOOD)[:-5],
    'big endian': capture(GOOD, order='>'),
    'nanoseconds': capture(GOOD, magic=0xA1B23C4D),
    'Linux': capture(bytes(14) + b'\x08\0' + ipv4(udp(b'abc')), link=LINUX),
    'VLAN': capture(ethernet(b'\0\5\x08\0' + ipv4(udp(b'abc')), 0x8100)),
    'ARP and spanning tree': capture(ethernet(bytes(46), 0x0806), ethernet(b'BBB' * 9, 27), GOOD),
    'TCP without content': capture(ethernet(ipv4(bytes(20), protocol=6)), GOOD),
    'padding': capture(GOOD + bytes(15)),
    'a length that the sender left out': capture(ethernet(ipv4(udp(b'abc'), total=0))),
    'fragments': capture(
        ethernet(ipv4(udp(b'12345678', 19), flags=MORE)), ethernet(ipv4(b'abc', flags=2))
    ),
}

REFUSED = {
    'empty': (capture(EMPTY), 'packet 1 is of UDP without content'),
    'empty, padded': (capture(GOOD, EMPTY + bytes(18)), 'packet 2 is of UDP without content'),
    'cut to its headers': (capture(ethernet(ipv4(udp(b''), total=900))), 'without content'),
    'empty, with options': (capture(ethernet(ipv4(bytes(4) + udp(b''), words=6))), 'without'),
    'empty, in a VLAN': (capture(ethernet(b'\0\5\x08\0' + ipv4(udp(b'')), 0x8100)), 'without'),
    'fragments without content': (capture(ethernet(ipv4(b'', flags=ELSE))), 'without content'),
    'another IP in it': (capture(ethernet(ipv4(ipv4(udp(b'')), protocol=4))), 'no plain IPv4'),
    'shorter than its header': (capture(ethernet(ipv4(b'', words=15))), 'no plain IPv4'),
    'less than IP': (capture(ethernet(b'E')), 'no plain IPv4'),
    'IPv6': (capture(ethernet(bytes(60), 0x86DD)), 'protocol 0x86dd; `tcpdump'),
    'SNAP': (capture(ethernet(b'\xaa\xaa\3\0\0\0\x08\0' + ipv4(udp(b'')), 36)), 'protocol 0x0024'),
    'no link layer': (capture(ipv4(udp(b'abc')), link=101), 'link type 101'),
    'less than Ethernet': (capture(bytes(13)), 'a packet of 13 bytes'),
    'pcapng': (b'\x0a\x0d\x0d\x0a' + bytes(60), "begins with '0a0d0d0a'"),
    'no head': (b'\xd4\xc3\xb2\xa1', 'expected a capture in pcap format'),
    'a packet of 4 GB': (
        capture() + struct.pack('<4I', 0, 0, 2**32 - 1, 0),
        'of 4294967295 bytes',
    ),
    'fragments that never end': (
        capture(
            *(ethernet(ipv4(bytes(16), number=n, flags=MORE)) for n in range(MAX_PENDING + 1))
        ),
        f'over {MAX_PENDING} packets of which fragments are missing',
    ),
    'packets of nothing': (
        capture(*[ethernet(b'', 0x0806)] * (MAX_PACKETS + MAX_PACKETS)),
        'packets in',
    ),
}


@pytest.mark.parametrize('name', READ)
def test_plain_captures_are_read(tmp_path, name):
    read(tmp_path, READ[name])


@pytest.mark.parametrize('name', REFUSED)
def test_captures_that_ouster_sdk_cannot_take_are_refused(tmp_path, name):
    content, message = REFUSED[name]
    with pytest.raises(FileFormatError, match=r'a\.pcap: ') as refused:
        read(tmp_path, content)
    assert message in str(refused.value)


def test_small_packets_are_counted_by_the_size_of_the_capture(tmp_path):
    number = MAX_PACKETS + 1
    packet = ethernet(ipv4(udp(b'a')))
    assert len(packet) + 16 > LEAST_BYTES
    read(tmp_path, capture(*[packet] * number))


@pytest.mark.parametrize(
    'value', [0, -1, 2**31 - 1, 10**7, 1e9, '128', None, [128]], ids=lambda value: f'{value!r:.9}'
)
@pytest.mark.parametrize('name', ['pixels_per_column', 'columns_per_frame', 'columns_per_packet'])
def test_metadata_of_impossible_sizes_are_refused(tmp_path, name, value):
    """ouster-sdk allocates the image: gigabytes, or for minutes."""
    with pytest.raises(FileFormatError, match=f'a.json: .*{name}'):
        read(tmp_path, capture(GOOD), {'a': [{'b': {name: value}}]})


@pytest.mark.parametrize('text', ['[' * 200_000, '{"a": 1' + '0' * 9999 + '}', '"a' + 'b' * 2**20])
def test_metadata_that_are_no_bounded_json_are_refused(tmp_path, text):
    (tmp_path / 'a.pcap').write_bytes(capture(GOOD))
    (tmp_path / 'a.json').write_text(text)
    with pytest.raises(FileFormatError, match=r'a\.json'):
        check_capture(tmp_path / 'a.pcap')


def test_a_pipe_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / 'a.pcap')
    with pytest.raises(FileFormatError, match='not a regular file'):
        check_capture(tmp_path / 'a.pcap')
