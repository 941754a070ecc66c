# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The picture of the README: a street as surfels, as its report shows it in a browser.

A simulated lidar drives 80 m; the bag is replayed, and its ``report.html`` opened in Chromium
without a window, turned, and drawn. Needs Chromium and playwright (extra ``test``).

    python examples/street_picture.py street.png
"""

import argparse
import os
from pathlib import Path
import shutil
import tempfile

from surfel_mapper import Config, replay
from surfel_mapper.simulation import Lidar, Simulation, World
from surfel_mapper.simulation.recording import record

SETTINGS = Config.from_mapping({'map': {'voxel_size_m': 0.3, 'min_points': 3}})
WIDTH, HEIGHT = 1140, 560
HIDE = """() => {
  for (const part of document.querySelectorAll('.tools, .scale')) part.style.visibility = 'hidden';
}"""


def draw(report, path):
    """Open a report, turn its map towards the street, and write what the canvas shows."""
    from playwright.sync_api import sync_playwright

    browser = next(filter(None, map(shutil.which, ('chromium', 'google-chrome'))), None)
    flags = ['--use-angle=swiftshader', '--enable-unsafe-swiftshader']
    if os.geteuid() == 0:  # containers
        flags.append('--no-sandbox')
    with sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=browser, args=flags)
        page = chromium.new_page(viewport={'width': WIDTH, 'height': 900})
        page.set_default_timeout(180_000)
        page.goto(report.resolve().as_uri())
        canvas = page.locator('#surfels')
        canvas.wait_for()
        box = canvas.bounding_box()
        x, y = box['x'] + box['width'] / 2, box['y'] + box['height'] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 50, y - 40, steps=5)
        page.mouse.up()
        for _ in range(5):
            page.mouse.wheel(0, -120)
        page.evaluate(HIDE)
        page.wait_for_timeout(1500)
        canvas.screenshot(path=path)
        chromium.close()


def main():
    """Simulate, replay, draw."""
    parser = argparse.ArgumentParser(description=str(__doc__).strip().partition('\n')[0])
    parser.add_argument('path', type=Path, help='picture to write, .png')
    parser.add_argument(
        'scans', type=int, nargs='?', default=160, help='length of the drive (%(default)s)'
    )
    args = parser.parse_args()

    with tempfile.TemporaryDirectory() as folder:
        bag, output = Path(folder) / 'bag', Path(folder) / 'map'
        street = World.street(seed=1, length_m=160.0)
        record(Simulation(street, Lidar(beams=64, columns=1024), num_scans=args.scans), bag)
        result = replay(bag, output=output, config=SETTINGS)
        draw(output / 'report.html', args.path)
    print(f'{args.path}: {len(result.mapper.map.surfels()):,} surfels')


if __name__ == '__main__':
    main()
