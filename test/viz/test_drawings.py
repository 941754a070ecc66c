# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The drawings of a layer, of models as an example, on pages and in pictures."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.layers.drawings import Section, Table
from surfel_mapper.layers.models.pictures import drawings_of, picture_of, section_of
from surfel_mapper.messages.model_messages import GREY, primitive_colors
from surfel_mapper.models import fit
from surfel_mapper.models.outlines import areas
from surfel_mapper.models.shapes import ellipsoid_corners, shape_of
from surfel_mapper.viz import drawings as viz_drawings
from surfel_mapper.viz.drawings import draw_points, page_meshes, section_html
from test.models.scenes import A, room, VIEW
from test.viz.test_report import plane, report


@pytest.fixture(scope='module')
def seen():
    model = fit(room(160, 120)[0], ModelsConfig(voxel_size_m=A), VIEW)
    return model, [shape_of(patch) for patch in model.patches]


def page_mesh(shapes, gaussians):
    return page_meshes(drawings_of(shapes, gaussians))['models']


def test_the_page_mesh_of_models_has_their_areas_in_their_colours(seen):
    model, shapes = seen
    mesh = page_mesh(shapes, model.gaussians)
    corners, colors = mesh.vertices[mesh.triangles], mesh.colors[mesh.triangles[:, 0]]
    for shape in shapes:
        own = np.rint(255 * primitive_colors([shape.patch.id])[0])
        area = areas(corners[(colors == own).all(axis=1)]).sum()
        assert area == pytest.approx(shape.area_m2)
    grey = (colors == np.rint(255 * np.array(GREY))).all(axis=1)
    assert grey.sum() == 20 * len(model.gaussians)
    expected = ellipsoid_corners(model.gaussians).reshape(-1, 3)
    np.testing.assert_allclose(mesh.vertices[-len(expected) :], expected, rtol=0, atol=1e-9)


def test_a_page_without_models_has_an_empty_mesh():
    assert len(page_mesh([], fit(np.empty((0, 3))).gaussians)) == 0


def test_a_page_gets_the_gaussians_that_fit_beside_the_patches(seen, monkeypatch):
    model, shapes = seen
    faces = sum(len(shape.faces) for shape in shapes)
    monkeypatch.setattr(viz_drawings, 'MAX_TRIANGLES', faces + 20 * 3 + 19)
    assert len(page_mesh(shapes, model.gaussians)) == faces + 20 * 3
    monkeypatch.setattr(viz_drawings, 'MAX_TRIANGLES', 10)
    assert len(page_mesh(shapes, model.gaussians)) == faces


def test_the_section_names_every_patch_with_its_numbers(seen):
    model, shapes = seen
    text = section_html(section_of(model, shapes))
    for shape in shapes:
        kind = 'surface' if shape.is_curved else 'plane'
        assert f'<td>{shape.patch.id}</td><td>{kind}</td>' in text
        assert f'>{shape.area_m2:.2f}</td>' in text
    # planes and surfaces hold the points that they are labelled with
    share = 100.0 * np.mean(model.labels < len(shapes))
    assert f'<dd>{share:.1f} %</dd>' in text
    assert f'<dt>Gaussians</dt><dd>{len(model.gaussians)}</dd>' in text


def test_models_of_nothing_are_a_section_too():
    text = section_html(section_of(fit(np.empty((0, 3))), []))
    assert '<dt>planes</dt><dd>0</dd>' in text
    assert '<table>' not in text


def test_models_are_a_layer_and_a_section_of_the_report(seen, tmp_path):
    model, shapes = seen
    picture = tmp_path / 'models.png'
    draw_points(picture, picture_of(room(160, 120)[0], model, VIEW, 'voxels'))
    section = section_html(section_of(model, shapes), picture)
    mesh = page_mesh(shapes, model.gaussians)
    parsed = report(tmp_path, plane(20), layers={'models': mesh}, sections=[section])
    assert any(text == 'models' for tag, _, text in parsed.text if tag == 'option')
    assert [a['src'][:22] for _, a in parsed.tags if a.get('class') == 'wide'] == [
        'data:image/png;base64,'
    ]


def painted(tmp_path, points, model, viewpoint):
    """Return the pixels (H, W, 3) of the picture of a cloud and its models, 0 to 1."""
    pyplot = pytest.importorskip('matplotlib.pyplot')
    path = tmp_path / 'models.png'
    draw_points(path, picture_of(points, model, viewpoint))
    return pyplot.imread(path)[:, :, :3]


def test_a_plane_fills_its_frame_in_its_shaded_colour(tmp_path):
    """Facing the viewer, a square of 2 m leaves a margin of 3 % at either side of its frame."""
    x, y = np.mgrid[-1:1:0.02, -1:1:0.02]
    points = np.stack([x, y, np.full_like(x, 3.0)], -1).reshape(-1, 3)
    model = fit(points, ModelsConfig(voxel_size_m=0.05))
    image = painted(tmp_path, points, model, np.zeros(3))
    light = viz_drawings.LIGHT / np.linalg.norm(viz_drawings.LIGHT)
    shade = viz_drawings.AMBIENT + (1.0 - viz_drawings.AMBIENT) * abs(light[2])
    (color,) = primitive_colors([plane.id for plane in model.planes])
    is_plane = (np.abs(image - shade * color[:3]) < 0.02).all(axis=2)
    is_frame = np.abs(image - viz_drawings.GROUND).max(axis=2) < 0.01
    right = slice(image.shape[1] // 2, None)
    assert is_plane[:, right].sum() > 0.8 * (is_plane | is_frame)[:, right].sum()
    assert not is_plane[:, : image.shape[1] // 2].any()


def test_pictures_of_rooms_are_mostly_filled(seen, tmp_path):
    image = painted(tmp_path, room(160, 120)[0], seen[0], VIEW)
    assert (image.min(axis=2) > 0.98).mean() < 0.2  # paper around the frames
    empty = np.abs(image - viz_drawings.GROUND).max(axis=2) < 0.01
    assert empty.mean() < 0.35


@pytest.mark.parametrize(
    ('viewpoint', 'ahead', 'up'),
    [
        ((0.0, 0.0, 1.0), (0.0, 0.6, -0.8), (0.0, 0.8, 0.6)),  # a lidar amid its scan
        ((0.0, 0.0, 90.0), (0.0, 0.6, -0.8), (0.0, 0.8, 0.6)),  # above a map
        ((0.0, 0.0, -90.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),  # a camera
        ((-90.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),  # a lidar on a side
    ],
)
def test_clouds_are_seen_from_the_sensor_or_from_above(viewpoint, ahead, up):
    x, y = np.mgrid[-10:11, -10:11]
    floor = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3).astype(np.float64)
    right = np.cross(ahead, up)
    expected = np.array([right, up, np.negative(ahead)])
    np.testing.assert_allclose(viz_drawings.view_axes(floor, np.array(viewpoint)), expected)


def test_far_points_are_left_out_of_the_frame():
    near = np.stack(np.meshgrid(*[np.linspace(0.0, 2.0, 100)] * 2), axis=-1).reshape(-1, 2)
    far = np.random.default_rng(0).uniform(0.0, 50.0, (300, 2))
    low, high = viz_drawings.frame_of(np.concatenate([near, far]))
    np.testing.assert_allclose(low, [0.0, 0.0], atol=0.6)
    np.testing.assert_allclose(high, [2.0, 2.0], atol=0.6)


def test_a_picture_of_nothing_has_two_empty_frames(tmp_path):
    image = painted(tmp_path, np.empty((0, 3)), fit(np.empty((0, 3))), np.zeros(3))
    assert (np.abs(image - viz_drawings.GROUND).max(axis=2) < 0.01).mean() > 0.5


def test_the_scale_bar_is_a_round_length_below_a_third_of_the_width():
    from matplotlib.figure import Figure  # seconds to import

    for width, text in ((10.0, '2 m'), (0.5, '10 cm'), (2000.0, '500 m')):
        ax = Figure().subplots()
        viz_drawings.draw_scale(ax, np.zeros(2), np.array([width, width]))
        ends = ax.lines[0].get_xdata()
        assert ax.texts[0].get_text() == text
        number, unit = text.split()
        assert ends[1] - ends[0] == pytest.approx(float(number) * (0.01 if unit == 'cm' else 1.0))


def test_texts_of_a_section_are_escaped():
    table = Table(titles=('<b>',), num_texts=1, rows=[['<i>']], colors=np.zeros((1, 3)))
    section = Section(title='<script>', figures={'<a>': '<u>'}, table=table, note='<s>')
    text = section_html(section)
    for tag in ('<script>', '<a>', '<u>', '<b>', '<i>', '<s>'):
        assert tag not in text
        assert tag.replace('<', '&lt;').replace('>', '&gt;') in text
