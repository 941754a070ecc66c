# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Checks of a capture of packets and its metadata, before ouster-sdk reads them.

ouster-sdk 1.0 ends the process at a UDP packet without content, takes time with the square of the
number of unfinished fragments, and allocates images of the size that the metadata states. So only
captures whose packets are plain UDP, or none of IP, get there; tcpdump makes such ones of others.

Source: the format of pcap files, ietf.org/archive/id/draft-ietf-opsawg-pcap.
"""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import struct
from typing import Any

from surfel_mapper.budget import open_regular, read_small_file
from surfel_mapper.errors import FileFormatError, refusing

ORDERS = {
    b'\xd4\xc3\xb2\xa1': '<',
    b'\x4d\x3c\xb2\xa1': '<',
    b'\xa1\xb2\xc3\xd4': '>',
    b'\xa1\xb2\x3c\x4d': '>',
}
"""Byte order by the magic; of microseconds and nanoseconds."""

LINK_BYTES = {1: 14, 113: 16}
"""Bytes of the header of the link layer, whose last two are the protocol: Ethernet, Linux."""

IPV4, VLANS = 0x0800, (0x8100, 0x88A8)
NO_IP = (0x0806, 0x88CC, 0x88F7)
"""Protocols that cannot hold IP: ARP, LLDP, PTP."""

MAX_LENGTH_FIELD, SNAP = 1500, 0xAA
"""Protocols up to here are lengths of 802.3, whose content is IP if it begins with SNAP."""

UDP, NO_UDP = 17, (1, 2, 6)
"""Protocols of IPv4 that are allowed: UDP; ICMP, IGMP and TCP, which cannot hold it."""

MAX_PENDING = 2000
"""Limit of the packets of which fragments are missing; they are searched one after the other."""

MAX_PACKETS, LEAST_BYTES = 10_000, 40
"""Limit of the packets of a small capture, and bytes of a capture for each further one."""

MAX_PACKET = 1 << 18
"""Limit of the bytes of a packet, as of libpcap."""

MOST = {'pixels_per_column': 1024, 'columns_per_frame': 8192, 'columns_per_packet': 1024}
"""Limits of the sizes in the metadata; lidars have up to 128, 4096 and 64."""

HINT = "`tcpdump -r IN -w OUT 'udp and udp[4:2] > 8'` keeps the others"


def check_capture(path: Path) -> None:
    """
    Raise FileFormatError if ouster-sdk must not read a capture, or the metadata beside it.

    A last packet that is cut off is left to ouster-sdk, which leaves it out.
    """
    for file in sorted(path.parent.glob('*.json')):
        if file.name[:1] == path.name[:1]:  # ouster-sdk takes the one whose name begins most alike
            check_metadata(file)
    with refusing(path, FileFormatError):
        size = path.stat().st_size
        pending: set[bytes] = set()
        for number, (protocol, packet) in enumerate(packets(path), start=1):
            if number > max(MAX_PACKETS, size // LEAST_BYTES):
                raise ValueError(f'over {number - 1} packets in {size} bytes')
            if protocol == IPV4:
                check_ipv4(packet, number, pending)
            elif protocol not in NO_IP and not is_plain_802_3(protocol, packet):
                raise ValueError(f'packet {number} is of protocol {protocol:#06x}; {HINT}')


def packets(path: Path) -> Iterator[tuple[int, memoryview]]:
    """Yield protocol and content of the whole packets of a capture; raise ValueError if none."""
    with open_regular(path) as file:
        head = file.read(24)
        order = ORDERS.get(head[:4])
        if order is None or len(head) < 24:
            raise ValueError(f'begins with {head[:4].hex()!r}, expected a capture in pcap format')
        (link,) = struct.unpack_from(f'{order}I', head, 20)
        if link not in LINK_BYTES:
            raise ValueError(f'link type {link}, expected Ethernet (1) or Linux (113)')
        record, skipped = struct.Struct(f'{order}8xI4x'), LINK_BYTES[link]
        while len(head := file.read(16)) == 16:
            (size,) = record.unpack(head)
            if size > MAX_PACKET:
                raise ValueError(f'a packet of {size} bytes, expected at most {MAX_PACKET}')
            packet = memoryview(file.read(size))
            if len(packet) < size:
                return
            if size < skipped:
                raise ValueError(f'a packet of {size} bytes, less than its header')
            at = skipped
            protocol = int.from_bytes(packet[at - 2 : at], 'big')
            while protocol in VLANS and len(packet) >= at + 4:
                at += 4
                protocol = int.from_bytes(packet[at - 2 : at], 'big')
            yield protocol, packet[at:]


def is_plain_802_3(length: int, packet: memoryview) -> bool:
    """Return whether a packet of a length, not a protocol, holds no IP."""
    return length <= MAX_LENGTH_FIELD and bytes(packet[:1]) != bytes([SNAP])


def check_ipv4(packet: memoryview, number: int, pending: set[bytes]) -> None:
    """Raise ValueError if a packet is UDP without content, or too many fragments are missing."""
    size = 4 * (packet[0] & 15) if packet else 0
    if size < 20 or len(packet) < size or packet[9] not in (UDP, *NO_UDP):
        raise ValueError(f'packet {number} is no plain IPv4; {HINT}')
    if packet[9] != UDP:
        return
    total = int.from_bytes(packet[2:4], 'big') or len(packet)
    flags, key = int.from_bytes(packet[6:8], 'big'), bytes(packet[4:6]) + bytes(packet[12:20])
    offset, has_more = flags & 0x1FFF, bool(flags & 0x2000)
    if 8 * offset + min(total, len(packet)) - size <= 8:
        raise ValueError(f'packet {number} is of UDP without content; {HINT}')
    if has_more:
        pending.add(key)
        if len(pending) > MAX_PENDING:
            raise ValueError(f'over {MAX_PENDING} packets of which fragments are missing')
    elif offset:
        pending.discard(key)


def check_metadata(path: Path) -> None:
    """Raise FileFormatError if the metadata of a lidar states sizes that none has."""
    with refusing(path, FileFormatError):
        waiting: list[Any] = [json.loads(read_small_file(path))]
        while waiting:
            found = waiting.pop()
            if isinstance(found, dict):
                for name in MOST.keys() & found.keys():
                    if not isinstance(found[name], int) or not 0 < found[name] <= MOST[name]:
                        raise ValueError(f'{name} {found[name]!r:.40}, expected 1 to {MOST[name]}')
            if isinstance(found, (dict, list)):
                waiting += found.values() if isinstance(found, dict) else found
