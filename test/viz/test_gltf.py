# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``view --glb`` writes glTF, read back here by its specification, without the library."""

from __future__ import annotations

from importlib.util import find_spec
import json
import struct
import sys

import numpy as np
import pytest

from surfel_mapper import SurfelMap
from surfel_mapper.cli.main import main
from surfel_mapper.files.mesh_ply import write_mesh
from surfel_mapper.viz.discs import CORNERS, DrawnDiscs, shaded
from test.viz.test_mesh import sphere
from test.viz.test_show import ground, ground_map, UTM

pytestmark = pytest.mark.skipif(
    find_spec('trimesh') is None, reason='trimesh is not installed (extra meshes)'
)

TYPES = {5120: 'i1', 5121: 'u1', 5123: '<u2', 5125: '<u4', 5126: '<f4'}
WIDTHS = {'SCALAR': 1, 'VEC3': 3, 'VEC4': 4}


class Glb:
    """The content of a .glb file: nodes, and accessors as arrays."""

    def __init__(self, path):
        content = path.read_bytes()
        magic, version, length = struct.unpack_from('<4sII', content)
        assert (magic, version, length) == (b'glTF', 2, len(content))
        size, kind = struct.unpack_from('<I4s', content, 12)
        assert kind == b'JSON'
        self.tree = json.loads(content[20 : 20 + size])
        binary_size, kind = struct.unpack_from('<I4s', content, 20 + size)
        assert kind == b'BIN\0'
        self._binary = content[28 + size : 28 + size + binary_size]

    def array(self, number):
        accessor = self.tree['accessors'][number]
        view = self.tree['bufferViews'][accessor['bufferView']]
        start = view.get('byteOffset', 0) + accessor.get('byteOffset', 0)
        count, width = accessor['count'], WIDTHS[accessor['type']]
        dtype = TYPES[accessor['componentType']]
        return np.frombuffer(self._binary, dtype, count * width, start).reshape(count, width)

    def node(self, name):
        """Return the primitive of a node, and its transform from the root."""
        node = next(each for each in self.tree['nodes'] if each.get('name') == name)
        matrix = np.array(node.get('matrix', np.eye(4).ravel())).reshape(4, 4).T
        (primitive,) = self.tree['meshes'][node['mesh']]['primitives']
        return primitive, matrix


def test_discs_are_triangles_with_normals_and_linear_colours(tmp_path):
    surfel_map = ground_map()
    surfel_map.save(tmp_path / 'map.npz')
    assert main(['view', str(tmp_path / 'map.npz'), '--glb', str(tmp_path / 'map.glb')]) == 0

    glb = Glb(tmp_path / 'map.glb')
    names = [node['name'] for node in glb.tree['nodes'] if 'mesh' in node]
    assert names
    places, normals, colours = [], [], []
    for name in names:
        assert name.startswith('map/map/tile_')
        primitive, matrix = glb.node(name)
        # y is up, and -z is y of the map
        np.testing.assert_array_equal(matrix @ [1.0, 2.0, 3.0, 1.0], [1.0, 3.0, -2.0, 1.0])
        assert primitive.get('mode', 4) == 4
        attributes = primitive['attributes']
        triangles = glb.array(primitive['indices'])
        places.append(glb.array(attributes['POSITION']))
        normals.append(glb.array(attributes['NORMAL']))
        colours.append(glb.array(attributes['COLOR_0'])[:, :3])
        assert len(triangles) == 3 * (CORNERS - 2) * len(places[-1]) // CORNERS

    discs = DrawnDiscs.of(surfel_map.surfels(5))
    middles = np.concatenate(places).reshape(-1, CORNERS, 3).mean(axis=1)
    order, expected = np.lexsort(middles.round(3).T), np.lexsort(discs.position.round(3).T)
    np.testing.assert_allclose(middles[order], discs.position[expected], atol=1e-4)
    of_discs = np.concatenate(normals)[::CORNERS][order]
    np.testing.assert_allclose(of_discs, discs.normal[expected], atol=1e-6)
    srgb = shaded(discs.normal[expected])
    linear = 255.0 * ((srgb + 0.055) / 1.055) ** 2.4  # all are above the linear part
    np.testing.assert_allclose(np.concatenate(colours)[::CORNERS][order], linear, atol=1.5)


def test_meshes_and_trajectories_are_nodes_beside_the_map(tmp_path):
    mesh = sphere(300)
    write_mesh(tmp_path / 'ball.ply', mesh)
    lines = [f'{1000 + i}.0 {i} 0 1 0 0 0 1\n' for i in range(4)]
    (tmp_path / 'drive.tum').write_text(''.join(lines), encoding='utf-8')
    files = [str(tmp_path / name) for name in ('ball.ply', 'drive.tum')]
    assert main(['view', *files, '--glb', str(tmp_path / 'all.glb')]) == 0

    glb = Glb(tmp_path / 'all.glb')
    primitive, _ = glb.node('map/ball')
    vertices = glb.array(primitive['attributes']['POSITION'])
    np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-5)
    np.testing.assert_array_equal(glb.array(primitive['indices']).reshape(-1, 3), mesh.triangles)
    way, _ = glb.node('map/drive')
    assert way['mode'] in (1, 3)  # lines, or one strip
    drawn = np.unique(glb.array(way['attributes']['POSITION']), axis=0)
    np.testing.assert_allclose(drawn, [[i, 0.0, 1.0] for i in range(4)], atol=1e-6)


def test_the_origin_of_a_map_is_stated_and_not_added(tmp_path):
    ground_map(origin_m=UTM).save(tmp_path / 'map.npz')
    assert main(['view', str(tmp_path / 'map.npz'), '--glb', str(tmp_path / 'map.glb')]) == 0
    glb = Glb(tmp_path / 'map.glb')
    assert glb.tree['scenes'][0]['extras']['origin_m'] == UTM.tolist()
    for each in glb.tree['accessors']:
        if each['type'] == 'VEC3':
            assert np.abs(each.get('max', 0.0)).max() < 100.0


@pytest.mark.parametrize(
    ('name', 'reason'), [('map.gltf', 'ending in .glb'), ('missing/map.glb', 'missing')]
)
def test_other_names_and_folders_are_refused(tmp_path, capsys, name, reason):
    ground_map().save(tmp_path / 'map.npz')
    assert main(['view', str(tmp_path / 'map.npz'), '--glb', str(tmp_path / name)]) == 1
    said = capsys.readouterr().err
    assert name in said
    assert reason in said
    assert 'Traceback' not in said


def test_an_empty_map_and_recordings_are_refused(tmp_path, capsys):
    SurfelMap(0.5).save(tmp_path / 'empty.npz')
    out = str(tmp_path / 'out.glb')
    assert main(['view', str(tmp_path / 'empty.npz'), '--glb', out]) == 1
    assert 'nothing to write' in capsys.readouterr().err
    (tmp_path / 'scans').mkdir()
    assert main(['view', str(tmp_path / 'scans'), '--glb', out]) == 2
    assert 'replay' in capsys.readouterr().err


def test_without_the_library_the_extra_is_named(tmp_path, capsys, monkeypatch):
    surfel_map = SurfelMap(0.5)
    surfel_map.add(ground())
    surfel_map.save(tmp_path / 'map.npz')
    monkeypatch.setitem(sys.modules, 'trimesh', None)
    assert main(['view', str(tmp_path / 'map.npz'), '--glb', str(tmp_path / 'map.glb')]) == 1
    assert 'surfel_mapper[meshes]' in capsys.readouterr().err
    assert not (tmp_path / 'map.glb').exists()
