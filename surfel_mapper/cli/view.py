# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper view``: maps, clouds, meshes, trajectories, bags and nodes in the viewer rerun.

Opens a window where there is a display, else a page for a browser. Both listen on loopback
only. A bag or folder of scans is mapped while it is shown, and nothing is written.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from surfel_mapper.cli._arguments import add_overwrite, finite, positive_int, UsageError
from surfel_mapper.cli._display import has_display
from surfel_mapper.cli._output import show_lines
from surfel_mapper.cli._settings import add_settings, configured
from surfel_mapper.cli._verbosity import add_verbosity, shown_progress
from surfel_mapper.errors import counted, escaped

if TYPE_CHECKING:
    from surfel_mapper.viz.contents import Content
    from surfel_mapper.viz.scene import Scene

SUMMARY = 'Show maps, clouds, meshes, models, trajectories, bags or a running node.'

EXAMPLE = 'surfel-mapper view street_surfels/ --color height'

COLOURS = (
    *('normal', 'height', 'planarity', 'curvature', 'num_points', 'thickness', 'normal_sigma'),
    *('radius', 'num_scans', 'size', 'intensity', 'rgb', 'age'),
)

LAST_PORT = 65_534
"""Last port of a page: the one after it is the last of TCP."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add(
        'what',
        type=Path,
        nargs='*',
        metavar='WHAT',
        help='output of a replay or merge; map: .npz, .parquet, .ply, .pcd, tiles; cloud, mesh '
        '(.ply, .obj, .stl, .glb), trajectory (.tum, .csv); or one bag or folder of scans',
    )
    add('--color', choices=COLOURS, default='normal', help='of the surfels (normal)')
    add(
        '--at',
        type=finite,
        nargs=3,
        metavar=('X', 'Y', 'Z'),
        help='place to look at, m in the fixed frame; maps are finest there (end of the '
        'trajectory, or middle of the map)',
    )
    add(
        '--discs',
        type=positive_int,
        default=250_000,
        metavar='N',
        help='most discs; far parts of larger maps are shown as coarser maps (250000)',
    )
    add('--min-points', type=positive_int, default=5, metavar='N', help='minimum per surfel (5)')
    add_settings(parser, 'settings for a bag; with its window')
    add(
        '--live',
        nargs='?',
        const='/surfel_mapper',
        metavar='NODE',
        help='show a running node instead, by its topics (/surfel_mapper)',
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument('--browser', action='store_true', help='serve a page until Ctrl-C')
    where.add_argument('--rrd', type=Path, metavar='FILE', help='write a file for rerun instead')
    add(
        '--port',
        type=page_port,
        default=0,
        metavar='N',
        help=f'of the page, at most {LAST_PORT}; its data use the next one (free ones)',
    )
    add_overwrite(parser)
    add_verbosity(parser)


def page_port(text: str) -> int:
    """Return the port of a page; the next one, of its data, is a port too."""
    port = positive_int(text)
    if port > LAST_PORT:
        raise argparse.ArgumentTypeError(f'{text!r}, expected a port up to {LAST_PORT}')
    return port


def run(args: argparse.Namespace) -> int:
    """Show a live node, a recording, or the contents of files, until Ctrl-C or SIGTERM."""
    from surfel_mapper.files.atomic import check_free
    from surfel_mapper.viz.contents import is_shown

    if bool(args.what) == (args.live is not None):
        raise UsageError('expected WHAT to show, or --live')
    if args.rrd is not None:
        check_free(args.rrd, args.overwrite)
    if args.live is not None:
        refuse_settings(args)
        show_live(args)
        return 0
    recordings = [path for path in args.what if path.exists() and not is_shown(path)]
    if recordings:
        if len(args.what) > 1:
            raise UsageError(f'{recordings[0]}: a recording is shown alone')
        with opened(args) as scene:
            announce(scene)
            show_recording(recordings[0], args, scene)
            with ended_by_interrupt(scene):
                scene.wait()
        return 0
    refuse_settings(args)
    show_files(args)
    return 0


def refuse_settings(args: argparse.Namespace) -> None:
    """Raise UsageError for settings, which a map or a node already has."""
    if args.config is not None or args.settings:
        raise UsageError('--config, --set and --voxel-size: expected a recording, to be mapped')


def show_files(args: argparse.Namespace) -> None:
    """Read files, show them, and wait if there is a page to serve."""
    from surfel_mapper.viz.contents import contents
    from surfel_mapper.viz.server import import_rerun

    many = len(args.what) > 1

    def read() -> list[Content]:
        names = [path.resolve().name if many and path.is_dir() else '' for path in args.what]
        pairs = zip(args.what, names, strict=True)
        return [content for path, name in pairs for content in contents(path, name)]

    with ThreadPoolExecutor(1) as reader:  # a large map takes longer to read than rerun to start
        reading = reader.submit(read)
        import_rerun()
        if args.rrd is not None or reading.done():
            reading.result()  # if it is refused, nothing is opened and no file overwritten
        with opened(args) as scene:
            announce(scene)
            with ended_by_interrupt(scene):
                show_all(scene, reading.result(), args)
                scene.wait()


def show_all(scene: Scene, contents: Sequence[Content], args: argparse.Namespace) -> None:
    """Show contents as the arguments ask for, and print a sentence about each."""
    from surfel_mapper.viz.show import show_contents

    about = show_contents(
        scene,
        contents,
        colouring=args.color,
        target=args.at,
        most_discs=args.discs,
        min_points=args.min_points,
    )
    for name, sentence in about.items():
        show_lines(escaped(f'{name}: {sentence}'))


def opened(args: argparse.Namespace) -> Scene:
    """Open the scene that the arguments ask for."""
    from surfel_mapper.viz.scene import Scene
    from surfel_mapper.viz.server import LIVE, WHOLE

    if args.rrd is not None:
        return Scene.to_file(args.rrd)
    if has_display() and not args.browser:
        return Scene.to_window()
    return Scene.to_browser(args.port, WHOLE if args.live is None else LIVE)


def announce(scene: Scene) -> None:
    """Print the address of the page, if there is one, and open it."""
    if scene.address:
        import webbrowser

        print(f'{scene.address}\nCtrl-C ends', flush=True)
        webbrowser.open(scene.address)


@contextmanager
def ended_by_interrupt(scene: Scene) -> Iterator[None]:
    """Take Ctrl-C as the end of a page or window; of a file it leaves a part, and is raised."""
    try:
        yield
    except KeyboardInterrupt:
        if not scene.is_watched:
            raise
        print(file=sys.stderr)


def show_live(args: argparse.Namespace) -> None:
    """Show a running node until Ctrl-C, or until the page ends."""
    from surfel_mapper.cli._ros import loading_ros

    with loading_ros(), opened(args) as scene:
        from surfel_mapper.ros.node_view import show_node

        announce(scene)
        try:
            show_node(scene, args.live, args.color, args.ros_args, scene.has_ended)
        except KeyboardInterrupt:  # the usual end, of a file too: it is whole
            print(file=sys.stderr)


def show_recording(path: Path, args: argparse.Namespace, scene: Scene) -> None:
    """Map a bag or a folder of scans while it is shown."""
    from surfel_mapper.offline.recording import open_recording
    from surfel_mapper.offline.replay import started_mapper
    from surfel_mapper.offline.request import Request
    from surfel_mapper.viz.viewer import Viewer

    with open_recording(Request(path=path), configured(args)) as recording:
        mapper = started_mapper(recording.config)
        viewer = Viewer(mapper, scene, args.color)
        with shown_progress(args, 'scan') as report:
            for number, update in enumerate(recording.replay(mapper), start=1):
                viewer.add(update)
                report(number, recording.num_scans)
        viewer.finish()
        summary = mapper.summary()
    mapped, surfels = summary['scans']['mapped'], summary['surfels']
    print(f'{counted(mapped, "scan")}, {counted(surfels, "surfel")} of the window')
