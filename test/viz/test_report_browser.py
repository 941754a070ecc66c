# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A report in a real browser, headless Chromium: no error, and a map that turns when dragged."""

from __future__ import annotations

from array import array
from dataclasses import replace
import io
import os
import re
import shutil
import time

import numpy as np
from PIL import Image
import pytest

from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.viz.discs import COLUMNS, OUTER, SPREAD
from surfel_mapper.viz.report import write_report
from test import extras
from test.viz.test_history import mapped
from test.viz.test_mesh import sphere
from test.viz.test_report import plane, report

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
BROWSER = next(filter(None, map(shutil.which, NAMES)), None)

pytestmark = [
    pytest.mark.skipif(
        BROWSER is None, reason=f'no browser on the PATH: none of {", ".join(NAMES)}'
    ),
    extras.needs('playwright'),
]

SOFTWARE_GL = ('--use-angle=swiftshader', '--enable-unsafe-swiftshader')
"""WebGL without a graphics card."""

SHOW_OVER = """(visibility) => {
  const over = document.querySelectorAll('.tools, .scale, .length');
  for (const part of over) part.style.visibility = visibility;
}"""
"""As a script's property: the policy of the page blocks further style sheets."""

WAIT_S = 180.0
"""Longest wait for an event that takes a second on an idle machine, s."""


@pytest.fixture(scope='module')
def browser():
    # root, as in containers, cannot have the sandbox
    root = ('--no-sandbox',) if os.geteuid() == 0 else ()
    playwright = extras.load('playwright.sync_api')
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(
            executable_path=BROWSER, args=[*SOFTWARE_GL, *root], timeout=1000 * WAIT_S
        )
        yield chromium
        chromium.close()


def new_page(browser):
    page = browser.new_page(viewport={'width': 640, 'height': 600})
    page.set_default_timeout(1000 * WAIT_S)
    return page


SWATCH = '<p id="swatch" style="color: rgb(1 2 3)">a</p>'


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    """Return the path of a report of a plane, not to be changed."""
    folder = tmp_path_factory.mktemp('report')
    report(folder, plane(30), sections=[SWATCH])
    return folder / 'report.html'


@pytest.fixture(scope='module')
def shown(browser, written):
    """Return a page that shows a report, and its console messages, errors and requests."""
    complaints, page = [], new_page(browser)
    address = written.as_uri()
    page.on('console', lambda message: complaints.append(message.text))
    page.on('pageerror', lambda error: complaints.append(str(error)))
    page.on('request', lambda asked: asked.url == address or complaints.append(asked.url))
    page.goto(address)
    page.locator('#surfels').wait_for()
    assert page.locator('#colouring').input_value() == 'normal'
    yield page, complaints
    page.close()


@pytest.fixture
def opened(shown):
    """Return the page as it is first shown, with the whole map and the first colours."""
    page, _ = shown
    page.locator('#colouring').select_option('normal', force=True)
    page.locator('#surfels').click(position={'x': 605, 'y': 8})  # above the horizon of the map
    page.locator('#surfels').evaluate('part => part.blur()')
    page.locator('#reset').dispatch_event('click')
    page.locator('#values').wait_for(state='hidden')
    picture_when(page, is_drawn)
    return shown


def settle(page):
    """Wait until drawing has finished, including the full frame that follows a movement."""
    page.evaluate(
        '() => new Promise((done) => setTimeout(() => requestAnimationFrame(done), 400))'
    )


def pixels(page):
    """Return the picture on the canvas, without what lies over it."""
    page.evaluate(SHOW_OVER, 'hidden')
    shot = Image.open(io.BytesIO(page.locator('#surfels').screenshot()))
    page.evaluate(SHOW_OVER, '')
    return np.asarray(shot.convert('RGB')) / np.float32(255.0)


def picture_when(page, is_so):
    """Return the picture once is_so(picture) holds, or the last one after WAIT_S."""

    def settled():
        settle(page)
        return pixels(page)

    return picture_until(is_so, settled)


def picture_until(is_so, draw):
    """Return draw() once is_so(picture) holds, or the last one after WAIT_S."""
    end = time.monotonic() + WAIT_S
    while True:
        image = draw()
        if is_so(image) or time.monotonic() > end:
            return image
        time.sleep(0.25)  # each picture is drawn by the processor


def num_coloured(image):
    return int((np.ptp(image, axis=2) > 0.1).sum())


def is_drawn(image):
    return num_coloured(image) > 5000  # discs on grey


def test_the_map_is_drawn_without_an_error_and_without_a_request(opened):
    page, complaints = opened

    assert is_drawn(pixels(page))
    assert complaints == []


def test_dragging_turns_the_map_and_reset_turns_it_back(opened):
    page, complaints = opened
    before = pixels(page)
    box = page.locator('#surfels').bounding_box()
    middle = box['x'] + box['width'] / 2, box['y'] + box['height'] / 2

    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 150, middle[1] + 40, steps=5)
    page.mouse.up()
    turned = picture_when(page, lambda image: np.abs(image - before).mean() > 0.005)
    page.locator('#reset').dispatch_event('click')
    again = picture_when(page, lambda image: np.allclose(image, before, atol=0.02))

    assert np.abs(turned - before).mean() > 0.005
    np.testing.assert_allclose(again, before, atol=0.02)
    assert complaints == []


def test_a_click_shows_the_values_of_a_surfel(opened):
    page, complaints = opened
    box = page.locator('#surfels').bounding_box()
    page.mouse.click(box['x'] + box['width'] / 2, box['y'] + box['height'] / 2)
    page.locator('#values').wait_for()
    found = shown_values(page)
    place = found['x y z']

    surfels = plane(30)
    away = np.linalg.norm(surfels.position - place, axis=1)
    assert away.min() < 0.02
    row = away.argmin()
    np.testing.assert_allclose(found['normal'], surfels.normal[row], atol=0.02)
    for name in COLUMNS:
        value = getattr(surfels, name)[row]
        # a column has 255 steps from its least to its largest value, and three digits
        step = np.ptp(getattr(surfels, name)) / 254.0 + 0.005 * abs(value)
        np.testing.assert_allclose(found[name.replace('_', ' ')], [value], atol=step)
    text = page.locator('#values').inner_text()
    assert re.search(r'thickness .* m\n', text)
    assert re.search(r'normal sigma .* rad\n', text)
    page.mouse.click(box['x'] + box['width'] - 5, box['y'] + 8)  # above the horizon of the map
    page.locator('#values').wait_for(state='hidden')
    assert complaints == []


def box_surfels():
    """Return the six sides of a box of 4 m, seen from inside, as a room."""
    steps = np.arange(0.0, 4.0, 0.08) + 0.04
    a, b = (axis.ravel() for axis in np.meshgrid(steps, steps))
    sides = []
    for axis in range(3):
        for end in (0.02, 3.98):
            sides.append(np.insert(np.column_stack([a, b]), axis, end, axis=1))
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.concatenate(sides), origin=[2.0, 2.0, 2.0])
    return surfel_map.surfels(20)


@pytest.fixture(scope='module')
def room(browser, tmp_path_factory):
    """Return a page that shows a room, and its surfels."""
    folder = tmp_path_factory.mktemp('room')
    surfels = box_surfels()
    mapper, history = mapped(3)
    for number, x in enumerate((0.5, 2.0, 3.5)):
        history._figures[6 * number + 3 : 6 * number + 6] = array('d', [x, 2.0, 2.0])
    write_report(folder / 'report.html', 'room', mapper.summary(), surfels, history)
    page = new_page(browser)
    page.goto((folder / 'report.html').as_uri())
    picture_when(page, is_drawn)
    yield page, surfels
    page.close()


def click(page, across, down):
    """Click at a part of the width and height of the canvas."""
    box = page.locator('#surfels').bounding_box()
    page.mouse.click(box['x'] + across * box['width'], box['y'] + down * box['height'])


def shown_values(page):
    """Return the numbers of the values that are shown, by name."""
    lines = page.locator('#values').inner_text().splitlines()
    named = (re.match(r'(x y z|[a-z ]*[a-z]) (-?[\d.].*)', line).groups() for line in lines)
    return {
        name: [float(n) for n in re.findall(r'-?[\d.]+(?:e-?\d+)?', text)] for name, text in named
    }


def test_a_click_picks_a_surfel_that_is_drawn_and_marks_it(room):
    page, surfels = room
    picked = 0
    for across, down in np.ndindex(5, 5):
        click(page, 0.3 + 0.1 * across, 0.3 + 0.1 * down)
        if not page.locator('#values').is_visible():
            continue
        picked += 1
        found = shown_values(page)
        # the viewer is above and to the south: ceiling and near wall face away
        assert found['normal'][2] > -0.2
        assert found['normal'][1] < 0.2
        away = np.linalg.norm(surfels.position - found['x y z'], axis=1)
        np.testing.assert_allclose(surfels.normal[away.argmin()], found['normal'], atol=0.02)
    assert picked >= 15
    click(page, 0.5, 0.5)
    settle(page)
    orange = np.abs(pixels(page) - [1.0, 0.55, 0.0]).max(axis=2) < 0.05
    assert orange.sum() > 30


def test_two_clicks_measure_the_distance_between_them(room):
    page, _ = room
    page.locator('#measure').click()
    page.locator('button', has_text='top').click()
    box = page.locator('#surfels').bounding_box()
    for across in (0.4, 0.6):
        click(page, across, 0.5)
    found = shown_values(page)
    page.locator('#measure').click()

    assert not page.locator('#values').is_visible()
    bar = page.locator('#bar').evaluate('bar => bar.getBoundingClientRect().width')
    metres = float(page.locator('#metres').inner_text().split()[0])
    # the bar holds at the middle of the room, the floor is 2 m farther
    expected = 0.2 * box['width'] * metres / bar
    assert found['distance'][0] == pytest.approx(expected, rel=0.35)
    assert found['horizontal'][0] == pytest.approx(found['distance'][0], rel=0.01)
    assert abs(found['height'][0]) < 0.05


def test_buttons_look_along_the_axes(room):
    page, _ = room
    seen = {}
    for name in ('top', 'front', 'side'):
        page.locator('button', has_text=name).click()
        settle(page)
        click(page, 0.5, 0.5)
        seen[name] = shown_values(page)['normal']
    np.testing.assert_allclose(seen['top'], [0.0, 0.0, 1.0], atol=0.1)
    np.testing.assert_allclose(seen['front'], [0.0, -1.0, 0.0], atol=0.1)
    np.testing.assert_allclose(seen['side'], [1.0, 0.0, 0.0], atol=0.1)
    page.locator('#reset').click()


def test_a_map_in_the_frame_of_a_camera_is_upright(browser, tmp_path):
    floor = plane(30)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # y down, z ahead
    report(tmp_path, turned(floor, turn))
    page = new_page(browser)
    page.goto((tmp_path / 'report.html').as_uri())
    picture_when(page, is_drawn)
    page.locator('button', has_text='top').click()
    click(page, 0.5, 0.5)
    shown = shown_values(page)
    np.testing.assert_allclose(shown['normal'], turn @ floor.normal[0], atol=0.02)
    assert shown['slope'][0] < 1.0
    page.close()


def turned(surfels, R):
    """Return flat surfels in another frame, with the sizes of their cells."""
    return replace(surfels, position=surfels.position @ R.T, normal=surfels.normal @ R.T)


def half_floor():
    """Return a floor that fills half of a cell of 4 m, and a small surfel below it."""
    steps = np.arange(0.0, 4.0, 0.05) + 0.025
    x, y = (axis.ravel() for axis in np.meshgrid(steps[:40], steps))
    floor = np.column_stack([x, y, np.full(len(x), 0.1)])
    surfel_map = SurfelMap(0.25)
    surfel_map.add(floor, origin=[2.0, 2.0, 5.0])
    surfel_map.add(floor[:50] * [0.1, 0.05, 1.0] + [1.05, 2.05, -0.2], origin=[2.0, 2.0, 5.0])
    return surfel_map.adaptive(5)


def test_a_disc_ends_one_voxel_beyond_its_cell(browser, tmp_path):
    surfels = half_floor()
    assert sorted(surfels.size.tolist()) == [0.25, 4.0]
    radius_m = SPREAD * surfels.radius.max()
    assert radius_m > 2.25  # the whole disc is wider than the cell
    report(tmp_path, surfels)
    page = new_page(browser)
    page.goto((tmp_path / 'report.html').as_uri())
    page.locator('button', has_text='top').click()
    rows, columns = np.nonzero(np.ptp(picture_when(page, is_drawn), axis=2) > 0.1)
    # from x = -0.25 to a corner of the octagon, from y = -0.25 to 4.25
    expected = (1.0 + OUTER * radius_m + 0.25) / 4.5
    assert np.ptp(columns) / np.ptp(rows) == pytest.approx(expected, rel=0.03)
    page.close()


@pytest.mark.parametrize('column', ['height', 'slope', 'num points', 'thickness', 'size'])
def test_every_column_has_a_legend(room, column):
    page, _ = room
    page.locator('#colouring').select_option(column)
    assert page.locator('#unit').inner_text().startswith(column)
    least, most = (float(page.locator(f'#{end}').inner_text()) for end in ('least', 'most'))
    assert least <= most
    page.locator('#colouring').select_option('normal')
    assert page.locator('.scale').inner_text().strip() == 'normal: red x, green y, blue z'


def test_the_slider_hides_what_the_sensor_passes_later(room):
    page, _ = room
    number = num_coloured(picture_when(page, is_drawn))
    set_time = """(part, value) => {
      part.value = value;
      part.dispatchEvent(new Event('input'));
    }"""
    page.locator('#time').evaluate(set_time, 0)
    fewer = picture_when(page, lambda image: num_coloured(image) < 0.9 * number)
    assert num_coloured(fewer) < 0.9 * number
    assert page.locator('#seconds').inner_text() == '0.0 s'
    page.locator('#time').evaluate(set_time, 255)


def test_a_phone_has_the_map_in_view(browser, written):
    context = browser.new_context(
        viewport={'width': 390, 'height': 844}, has_touch=True, is_mobile=True
    )
    page = context.new_page()
    page.set_default_timeout(1000 * WAIT_S)
    page.goto(written.as_uri())
    canvas, tools = (page.locator(name).bounding_box() for name in ('#surfels', '.tools'))
    assert canvas['y'] + canvas['height'] < 844
    assert canvas['height'] > 300
    assert tools['y'] >= canvas['y'] + canvas['height']  # beside the map, not over it
    assert page.evaluate('document.documentElement.scrollWidth') <= 390
    page.locator('#surfels').tap()
    page.locator('#values').wait_for()
    context.close()


def test_a_mesh_can_be_shown_in_its_colours(browser, tmp_path):
    report(tmp_path, plane(30), layers={'mesh': sphere(40, 3.0, (7.5, 7.5, 0.0))})
    complaints, page = [], new_page(browser)
    page.on('console', lambda message: complaints.append(message.text))
    page.on('pageerror', lambda error: complaints.append(str(error)))
    page.goto((tmp_path / 'report.html').as_uri())
    page.locator('#shown').select_option('mesh')

    def is_red_above_blue(image):
        red = (image[..., 0] > 0.3) & (image[..., 1:].max(axis=2) < 0.05)
        blue = (image[..., 2] > 0.3) & (image[..., :2].max(axis=2) < 0.05)
        # seen from above, more of the upper half
        is_more = red.sum() > blue.sum() > 500
        return is_more and np.nonzero(red)[0].mean() < np.nonzero(blue)[0].mean()

    assert is_red_above_blue(picture_when(page, is_red_above_blue))
    assert not page.locator('#colouring').is_visible()
    assert complaints == []
    page.close()


def test_without_webgl_the_page_says_so(browser, tmp_path):
    report(tmp_path, plane(3))
    page = new_page(browser)
    page.add_init_script('HTMLCanvasElement.prototype.getContext = () => null')
    errors = []
    page.on('pageerror', lambda error: errors.append(str(error)))
    page.goto((tmp_path / 'report.html').as_uri())

    assert page.get_by_text('This browser has no WebGL 2.').is_visible()
    assert not page.locator('#surfels').is_visible()
    assert errors == []
    page.close()


INJECTED = (
    '<script>document.title = "injected"</script>',
    '<img src="data:," onerror="document.title = \'injected\'">',
    '<p id="injected" style="color: rgb(1 2 3)">injected</p>',
    '<style>h1 { color: rgb(1 2 3) }</style>',
    '<base href="https://example.invalid/">',
    '<img src="https://example.invalid/a.png">',
)


def test_the_policy_blocks_everything_injected_into_the_page(browser, written, tmp_path):
    path = tmp_path / 'report.html'
    text = written.read_text(encoding='utf-8')
    injected = ''.join(INJECTED)
    path.write_text(text.replace('<h1>', f'{injected}<h1>', 1), encoding='utf-8')
    complaints, page = [], new_page(browser)
    page.on('console', lambda message: complaints.append(message.text))
    page.goto(path.as_uri())
    page.locator('#surfels').wait_for()

    assert page.title() != 'injected'
    for part in ('#injected', 'h1'):
        colour = page.locator(part).first.evaluate('part => getComputedStyle(part).color')
        assert colour != 'rgb(1, 2, 3)'
    assert page.evaluate('document.baseURI').startswith('file:')
    blocked = [text for text in complaints if 'Content Security Policy' in text]
    assert len(set(blocked)) == len(INJECTED), complaints
    page.close()
