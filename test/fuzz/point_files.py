# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Harnesses of files of points and poses: LAS, PLY, PCD, TUM, tiles, captures of packets.

Those that build a file from choices remember what is in it: unless they changed the file, the
reader has to return that. A file whose header was changed is refused, or read within the limits.
"""

from __future__ import annotations

import contextlib
from functools import cache
import io
from pathlib import Path
import struct
import tempfile

import numpy as np

from surfel_mapper.errors import SurfelMapperError
from surfel_mapper.files import ply
from surfel_mapper.files.parquet_tiles import read_tiles
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.files.stamps import read_dates, read_times
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.viz.contents import contents
from test.fuzz.files import folder, refused, timed_read
from test.fuzz.mutations import mutations
from test.fuzz.source import Source
from test.fuzz.structures import SIZES

RESOLUTION_M = 1e-3

LAS_FIELDS = (
    (94, '<H'),
    (96, '<I'),
    (100, '<I'),
    (104, '<B'),
    (105, '<H'),
    (107, '<I'),
    (131, '<d'),
    (155, '<d'),
    (227, '<Q'),
    (235, '<Q'),
    (243, '<I'),
    (247, '<Q'),
    (281, '<H'),
    (331, '<I'),
)
"""Places in a LAS file, and their types: header size, start, records, format, size and count of
points, scale, offset, waveforms, start and number of extended records, count of 1.4; and of the
first record of variable length its size and, in LAZ, the size of chunks."""

NUMBERS = {'i1', 'u1', 'i2', 'u2', 'i4', 'u4', 'f4', 'f8'}


def las(data: bytes) -> None:
    """Read a LAS or LAZ file."""
    refused(read_scan, 'input.las', data)


def las_structure(data: bytes) -> None:
    """Read a LAS or LAZ file of some points whose header may be false."""
    import laspy

    source = Source(data)
    point_format = source.pick((0, 1, 2, 3, 6, 7))
    header = laspy.LasHeader(point_format=point_format, version='1.4')
    header.scales = np.full(3, RESOLUTION_M)
    if source.chance(2):
        header.add_extra_dims([laspy.ExtraBytesParams('more', source.pick(('u1', '3f8')))])
    points = np.arange(3.0 * source.pick((0, 1, 100, 5000))).reshape(-1, 3) * RESOLUTION_M
    made = laspy.LasData(header)
    made.x, made.y, made.z = points.T
    file = io.BytesIO()
    made.write(file, do_compress=source.chance(2))
    content = bytearray(file.getvalue())
    is_changed = source.chance(2)
    for _ in range((1 + source.below(3)) * is_changed):
        at, code = source.pick(LAS_FIELDS)
        value = (
            source.real() if code == '<d' else source.pick(SIZES) % 256 ** struct.calcsize(code)
        )
        struct.pack_into(code, content, at, value)
    if source.chance(4):  # of LAZ: the place of its table of chunks; of LAS: a point
        is_changed = True
        struct.pack_into('<Q', content, min(header.offset_to_point_data, len(content) - 8), 2**63)
    if source.chance(4):
        is_changed = True
        del content[source.below(1 << 16) % len(content) :]
    same_points('structure.las', bytes(content), None if is_changed else points)


def same_points(name: str, content: bytes, points: np.ndarray | None) -> None:
    """Read a file of points; unless it was changed, compare them with those in it."""
    found = None
    path = Path(folder().name, name)
    path.write_bytes(content)
    with timed_read(len(content)), contextlib.suppress(SurfelMapperError):
        found, _ = read_scan(path)
    if points is not None:
        assert found is not None, content[:400]
        np.testing.assert_allclose(found, points, rtol=1e-6, atol=1e-9)


def table(source: Source) -> np.ndarray:
    """Return a table of points with further columns of any type."""
    names = [*'xyz', *(f'c{number}' for number in range(source.pick((0, 1, 5, 300))))]
    order = source.pick('<>')
    kinds = ['f4' if source.below(2) else 'f8'] * 3
    kinds += [source.pick(sorted(NUMBERS)) for _ in names[3:]]
    rows = np.zeros(
        source.pick((1, 7, 300)), [(n, order + k) for n, k in zip(names, kinds, strict=True)]
    )
    for name in names:
        rows[name] = np.arange(len(rows)) % 100
    return rows


def xyz_of(rows: np.ndarray) -> np.ndarray:
    """Return the points of a table, (N, 3)."""
    return np.stack([rows[axis].astype(np.float64) for axis in 'xyz'], axis=1)


def text_of(rows: np.ndarray) -> bytes:
    """Return a table as lines of numbers."""
    return b''.join(' '.join(map(str, row.tolist())).encode() + b'\n' for row in rows)


PLY_NAMES = {code: name for name, code in list(ply.TYPES.items())[8:]}


def ply_structure(data: bytes) -> None:
    """Read a PLY file with other elements around its points, and counts that may be false."""
    source = Source(data)
    rows = table(source)
    is_text = source.chance(3)
    order = '<' if rows.dtype['x'].str[0] in '<|' else '>'
    kind = 'ascii' if is_text else f'binary_{"little" if order == "<" else "big"}_endian'
    is_changed = source.chance(3)
    count = source.pick(SIZES) if is_changed else len(rows)
    head = [f'ply\nformat {kind} 1.0', f'element vertex {count}']
    head += [f'property {PLY_NAMES[rows.dtype[n].str[1:]]} {n}' for n in rows.dtype.names]
    faces = source.pick((0, 0, 2))
    if faces:
        head += [f'element face {faces}', 'property list uchar int vertex_indices']
    if source.chance(8):
        is_changed = True
        head.insert(1 + source.below(len(head)), source.pick(('element x -1', 'property', 'obj')))
    face = b'3 0 0 0\n' if is_text else b'\3' + bytes(12)
    body = text_of(rows) if is_text else rows.tobytes()
    content = '\n'.join([*head, 'end_header\n']).encode() + body + face * faces
    if source.chance(6):
        is_changed = True
        content = content[: len(content) - source.below(200)]
    same_points('structure.ply', content, None if is_changed else xyz_of(rows))


def pcd_structure(data: bytes) -> None:
    """Read a PCD file in any encoding whose header may be false."""
    import lzf

    source = Source(data)
    rows = table(source)
    rows = rows.astype(rows.dtype.newbyteorder('<'))
    encoding = source.pick(('ascii', 'binary', 'binary_compressed'))
    names = rows.dtype.names
    kinds = [rows.dtype[name] for name in names]
    is_changed = source.chance(2)
    values = {
        'FIELDS': [*names],
        'SIZE': [str(kind.itemsize) for kind in kinds],
        'TYPE': [{'f': 'F', 'i': 'I', 'u': 'U'}[kind.kind] for kind in kinds],
        'COUNT': ['1'] * len(names),
        'WIDTH': [str(len(rows))],
        'HEIGHT': ['1'],
        'POINTS': [str(len(rows))],
    }
    for _ in range((1 + source.below(2)) * is_changed):
        entry = values[source.pick(sorted(values))]
        entry[source.below(len(entry))] = str(source.pick((*SIZES, -1, 'F', 'x')))
    head = ['VERSION 0.7', *(f'{name} {" ".join(v)}' for name, v in values.items())]
    body = text_of(rows) if encoding == 'ascii' else rows.tobytes()
    if encoding == 'binary_compressed':
        plain = b''.join(np.ascontiguousarray(rows[name]).tobytes() for name in names)
        packed = lzf.compress(plain, 2 * len(plain) + 64)
        sizes = [len(packed), len(plain)]
        if source.chance(4):
            is_changed = True
            sizes[source.below(2)] = source.pick(SIZES) % 2**32
        body = struct.pack('<II', *sizes) + packed
    content = '\n'.join([*head, f'DATA {encoding}\n']).encode() + body
    if source.chance(6):
        is_changed = True
        content = content[: len(content) - source.below(200)]
    same_points('structure.pcd', content, None if is_changed else xyz_of(rows))


def trajectory_structure(data: bytes) -> None:
    """Read thousands of poses, one line of which may be odd."""
    source = Source(data)
    number = source.pick((1, 2, 50, 3000))
    lines = [f'{row}.5 {row} 0 0 0 0 0 1' for row in range(number)]
    is_changed = source.chance(2)
    if is_changed:
        tokens = lines[row := source.below(number)].split()
        tokens[source.below(8)] = source.pick(
            ('', 'x', 'nan', '1e999', str(source.real()), '9' * 5000)
        )
        lines[row] = ' '.join(tokens) * source.pick((1, 1, 300))
    if source.chance(3):
        lines.insert(0, '# a comment')
    content = source.pick(('\n', '\r\n')).join(lines).encode() + b'\n'
    found = None
    path = Path(folder().name, 'structure.tum')
    path.write_bytes(content)
    with timed_read(len(content)), contextlib.suppress(SurfelMapperError):
        found = read_trajectory(path, source.pick(('tum', None)))
    if not is_changed:
        assert found is not None
        np.testing.assert_array_equal(found.xyz[:, 0], np.arange(number))


TABLES = {
    'a.tum': ('', '{0} 0 0 0 0 0 0 1'),
    'b.tum': ('', '1 0 0 0 0 1 0 0 0 0 1 0'),
    'c.tum': ('t,x,y,z,qx,qy,qz,qw\n', '{0},0,0,0,0,0,0,1'),
    'times': ('', '{0}'),
    'dates': ('', '2011-09-26 13:02:25.594360375'),
    'a.ply': (
        'ply\nformat ascii 1.0\nelement vertex {0}\nproperty float x\nproperty float y\n'
        'property float z\nend_header\n',
        '{0} 0 0',
    ),
    'a.pcd': (
        'FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\n'
        'DATA ascii\n',
        '{0} 0 0',
    ),
}
"""Tables in text by the name of their file: the head, with the number of rows, and a row."""

ODD_WORDS = (
    '',
    ' ',
    '#',
    ',',
    'x',
    'nan',
    '1e999',
    '0e00001',
    '-0',
    '9' * 50,
    '.9995',
    '1_0',
    'é',
)


def long_table(data: bytes) -> None:
    """Read tables of up to a megabyte whose rows are as short as can be, one word of them odd."""
    source = Source(data)
    name = source.pick(sorted(TABLES))
    head, row = TABLES[name]
    size = source.pick((1 << 14, 1 << 17, 1 << 20))
    stamp = source.pick(('{0}', '{0}e0', '{0}.', '+{0}', '{0}.{0:025}', '{0:e}', '0'))
    words = row.replace('{0}', stamp).split(' ')
    if source.chance(2):
        words[source.below(len(words))] = source.pick(ODD_WORDS)
    line = source.pick((' ', ' ', '  ')).join(words) + source.pick(('\n', '\n', '\r\n', '\n\n'))
    number = size // max(len(line), 1)
    lines = [line.format(at) for at in range(number)]
    for _ in range(source.below(3)):
        lines[source.below(number)] = source.pick((*ODD_WORDS, f'{row}\n', '# a\n', row[:-1]))
    content = (head.format(number) + ''.join(lines)).encode()
    if source.chance(3):
        content = content[:-1]
    read = {'times': read_times, 'dates': read_dates}.get(name, lambda path: [*contents(path)])
    refused(read, name, content)


def tile(data: bytes) -> None:
    """Read a map of one tile."""
    name = 'tile_i=0/tile_j=0/surfels.parquet'
    tiled = Path(folder().name, 'tiled')
    (tiled / name).parent.mkdir(parents=True, exist_ok=True)
    refused(lambda path: read_tiles(tiled), f'tiled/{name}', data)


SHOWN = ('.obj', '.stl', '.glb')


def shown(data: bytes) -> None:
    """Read a file that ``view`` shows; the first byte selects its kind."""
    suffix = SHOWN[data[0] % len(SHOWN) if data else 0]
    refused(lambda path: [*contents(path)], f'input{suffix}', data[1:])


@cache
def capture() -> tuple[bytes, bytes]:
    """Return a capture of two small scans of an Ouster lidar, and its metadata."""
    from ouster.sdk import core, pcap

    info = core.SensorInfo.from_default(core.LidarMode('512x10'))
    info.config.udp_port_lidar, info.config.udp_port_imu = 7502, 7503
    packets = []
    for number in range(2):
        frame = core.LidarFrame(info)
        frame.frame_id = number
        frame.field('RANGE')[:] = 5000
        frame.measurement_id[:] = np.arange(512)
        frame.timestamp[:] = 10**18 + number * 10**8 + np.arange(512)
        frame.packet_timestamp[:] = frame.timestamp[:: 512 // len(frame.packet_timestamp)]
        frame.status[:] = 1
        packets += core.frame_to_packets(frame, core.PacketFormat(info), 0, 0)[:3]
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, 'a.pcap')
        pcap.record(packets, str(path))
        return path.read_bytes(), info.to_json_string().encode()


def packets(data: bytes) -> None:
    """Read a capture and its metadata, one of which is changed."""
    from surfel_mapper.offline.ouster_pcap import OusterPcap

    source = Source(data)
    originals = capture()
    number, seed = source.below(2), source.below(1 << 16)
    *_, changed = mutations([originals[number]], 1, seed=seed)
    captured, described = (changed, originals[1]) if number == 0 else (originals[0], changed)
    Path(folder().name, 'capture.json').write_bytes(described)

    def read(path: Path) -> None:
        found = OusterPcap(path)
        for scan in range(min(len(found.files), 5)):
            found.scan(scan)

    refused(read, 'capture.pcap', captured)
