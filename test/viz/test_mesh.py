# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The mesh on a page: positions, normals and simplification."""

import base64
import json

import numpy as np
import pytest

from surfel_mapper.tsdf.mesh import EMPTY, Mesh
from surfel_mapper.viz.mesh import MAX_TRIANGLES, reduced, VERTEX, vertex_normals
from surfel_mapper.viz.report import write_report
from test.viz.test_history import mapped
from test.viz.test_report import Parsed, plane


def sphere(num, radius_m=2.0, middle=(0.0, 0.0, 0.0)):
    """Return a closed sphere of about 4 num^2 triangles, coloured by hemisphere."""
    across, along = np.meshgrid(np.arange(2 * num), np.arange(num + 1))
    turn, fall = np.pi * across / num, np.pi * along / num
    unit = np.stack(
        [np.sin(fall) * np.cos(turn), np.sin(fall) * np.sin(turn), np.cos(fall)], axis=-1
    ).reshape(-1, 3)
    row, column = np.divmod(np.arange(2 * num * num), 2 * num)
    right = (column + 1) % (2 * num)
    a, b = row * 2 * num + column, row * 2 * num + right
    c, d = a + 2 * num, b + 2 * num
    triangles = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    colors = np.where(unit[:, 2:] > 0, [250, 0, 0], [0, 0, 250]).astype(np.uint8)
    return Mesh(
        vertices=radius_m * unit + middle, triangles=triangles.astype(np.int32), colors=colors
    )


def test_normals_point_away_from_the_middle_of_a_sphere():
    mesh = sphere(40)
    normals = vertex_normals(mesh)
    unit = mesh.vertices / 2.0
    rest = np.abs(unit[:, 2]) < 0.999  # several vertices are at a pole
    assert (normals * unit).sum(axis=1)[rest].min() > 0.99


@pytest.mark.parametrize('most', [2000, 10_000])
def test_a_reduced_mesh_keeps_shape_and_colours(most):
    mesh = sphere(100)
    small = reduced(mesh, most)
    assert most / 4 < len(small) <= most
    cell_m = np.sqrt(4 * np.pi * 4.0 / len(small))
    assert np.abs(np.linalg.norm(small.vertices, axis=1) - 2.0).max() < 0.3 * cell_m
    # No hole: every edge is there once in either direction.
    edges = np.concatenate(
        [small.triangles[:, [0, 1]], small.triangles[:, [1, 2]], small.triangles[:, [2, 0]]]
    )
    once = {tuple(edge) for edge in edges.tolist()}
    assert np.mean([(b, a) in once for a, b in once]) > 0.99
    top = small.vertices[:, 2] > 0.2
    assert (small.colors[top] == [250, 0, 0]).all()


def page(tmp_path, *meshes, surfels=None):
    mapper, history = mapped(3)
    path = tmp_path / 'report.html'
    layers = {f'layer {n}': mesh for n, mesh in enumerate(meshes) if mesh is not None}
    shown = plane(20) if surfels is None else surfels
    write_report(path, 'street', mapper.summary(), shown, history, layers=layers)
    text = path.read_text(encoding='utf-8')
    parsed = Parsed(text)
    return len(text), parsed, json.loads(parsed.one('script', id='map'))


def test_the_page_holds_the_mesh_where_it_is(tmp_path):
    mesh = sphere(30, middle=(5.0, 5.0, 5.1))
    size, _, data = page(tmp_path, mesh)
    surfels = plane(20)
    low, high = surfels.position.min(axis=0), surfels.position.max(axis=0)
    (layer,) = data['layers']
    rows = np.frombuffer(base64.b64decode(layer['vertices']), VERTEX)
    triangles = np.frombuffer(base64.b64decode(layer['triangles']), '<u4').reshape(-1, 3)
    reach = np.array(layer['reach'])
    places = 0.5 * (low + high) + (2.0 * rows['place'] / 65535.0 - 1.0) * reach
    assert triangles.max() == len(rows) - 1
    distance = np.linalg.norm(places - [5.0, 5.0, 5.1], axis=1)
    assert np.abs(distance - 2.0).max() < 1e-3
    assert size < 2_000_000


def test_a_large_mesh_makes_no_large_page(tmp_path):
    size, parsed, data = page(tmp_path, sphere(300, 20.0, (5.0, 5.0, 5.0)))
    assert size < 2_000_000
    assert len(base64.b64decode(data['layers'][0]['triangles'])) <= 12 * MAX_TRIANGLES
    assert 'shown' in [attributes.get('id') for _, attributes in parsed.tags]


def test_without_a_mesh_there_is_nothing_to_choose(tmp_path):
    for mesh in (None, EMPTY):
        _, parsed, data = page(tmp_path, mesh)
        assert data['layers'] == []
        assert 'shown' not in [attributes.get('id') for _, attributes in parsed.tags]
