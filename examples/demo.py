# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A simulated drive, mapped twice: live by the ROS 2 node, and from its bag without ROS.

Both maps hold the same numbers to the last bit, which their digests show. ``make demo`` runs
this; every step is a command that you can type yourself, and is printed before it runs. Without
ROS 2 the live part is left out, and the bag is mapped alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
import json
import os
from pathlib import Path
import re
import shlex
import socket
import subprocess
import sys
import time
import webbrowser

SETTINGS = Path(os.path.relpath(Path(__file__).with_name('street.yaml')))

COMMAND = [sys.executable, '-m', 'surfel_mapper.cli.main']
"""The program `surfel-mapper`, wherever it is installed."""


def main() -> int:
    """Run all steps; return 0 if both maps are equal."""
    args = arguments()
    bag, live, offline = (args.output / name for name in ('street', 'live', 'offline'))

    say('1. A lidar drives through a street, and a bag records it.')
    lidar = ['--scans', args.scans, '--beams', args.beams, '--columns', args.columns]
    call('simulate', 'street', '--output', bag, '--overwrite', '--noise', 0.02, *lidar)

    if find_spec('rclpy') is None:
        say(
            '2. The live node is left out: ROS 2 is not installed (rclpy). '
            "`pip install '.[ros]'` installs it on Linux on x86_64."
        )
        say('3. The bag is mapped, without ROS.')
        call('replay', bag, '--config', SETTINGS, '--window', '--output', offline, '--overwrite')
        print_files(offline, args.open)
        return 0
    say('2. The node maps the bag while it is played, as it would on a robot.')
    with (
        own_domain(),
        node('--params-file', SETTINGS, '-p', f'output.directory:={live}') as running,
    ):
        played = play(running, bag)
        mapped = save_map()

    say('3. The bag is mapped once more, by itself.')
    call('replay', bag, '--config', SETTINGS, '--window', '--output', offline, '--overwrite')
    summary = json.loads((offline / 'summary.json').read_text(encoding='utf-8'))

    say('4. Are the maps equal?')
    print(f'live     {mapped["digest"]}\noffline  {summary["digest"]}')
    sent, received = played['published']['/points'], int(mapped['received'])
    if received < sent:
        print(f'{sent - received} of {sent} clouds were lost on the way to the node.')
    if mapped['digest'] != summary['digest']:
        print('The maps differ.')
        return 1
    print('They are equal to the last bit.')
    print_files(offline, args.open)
    return 0


def print_files(directory: Path, is_opened: bool) -> None:
    """Print the files of a replay that are worth opening, the picture last; open the report."""
    if is_opened:
        webbrowser.open((directory / 'report.html').resolve().as_uri())
    print(
        f'\nmap      {directory / "map.ply"} (CloudCompare and MeshLab open it)\n'
        f'figures  {directory / "summary.json"}\n'
        f'report   {directory / "report.html"} (--open shows it)\n'
        f'picture  {directory / "map.png"}'
    )


def arguments() -> argparse.Namespace:
    """Return the arguments; the defaults take about half a minute."""
    parser = argparse.ArgumentParser(description=str(__doc__).strip().partition('\n')[0])
    parser.add_argument('--output', type=Path, default=Path('demo'), help='directory to write to')
    parser.add_argument('--scans', type=int, default=100, help='length of the drive')
    parser.add_argument('--beams', type=int, default=64, help='of the lidar')
    parser.add_argument('--columns', type=int, default=1024, help='of the lidar, a turn')
    parser.add_argument('--open', action='store_true', help='open the report in a browser')
    return parser.parse_args()


def say(text: str) -> None:
    """Print the heading of a step."""
    print(f'\n{text}', flush=True)


def command(*words: object) -> list[str]:
    """Print a command as one would type it; return it as it is run."""
    typed = [str(word) for word in words]
    print(f'$ surfel-mapper {shlex.join(typed)}', flush=True)
    return [*COMMAND, *typed]


def call(*words: object) -> None:
    """Run a command; end the demo if it fails."""
    done = subprocess.run(command(*words))
    if done.returncode:
        sys.exit(done.returncode)


@contextmanager
def own_domain() -> Iterator[None]:
    """
    Keep the nodes of this demo apart from all others, in a ROS domain claimed for a with-block.

    The claim is a socket of that name, which ends with the process; tests claim theirs likewise.
    """
    for number in [*range(1 + os.getpid() % 100, 101), *range(1, 101)]:
        with socket.socket(socket.AF_UNIX) as claim:
            try:
                claim.bind(f'\0surfel_mapper-ros-domain-{number}')
            except OSError:  # taken
                continue
            os.environ['ROS_DOMAIN_ID'] = str(number)
            os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
            print(f'ROS domain {number}, on this machine only')
            yield
            return
    sys.exit('ROS domains 1 to 100 are all taken by other runs of the demo and tests.')


@contextmanager
def node(*ros_args: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run the node as a process of its own for the time of a with-block."""
    process = subprocess.Popen(command('node', '--ros-args', *ros_args))
    try:
        yield process
    finally:
        process.terminate()  # it logs its counts, and ends
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()


def play(running: subprocess.Popen[bytes], bag: Path) -> dict[str, dict[str, int]]:
    """Play the bag as fast as the node maps it, once it is ready; return the messages sent."""
    paced = ['--paced-by', '/surfel_mapper/changed', '--timeout', 1800]
    words = command('play', bag, '--wait-for', '/points', '/odom', *paced, '--json')
    with subprocess.Popen(words, stdout=subprocess.PIPE) as playing:
        while playing.poll() is None:
            if running.poll() is not None:
                playing.terminate()
                sys.exit('The node ended too early.')
            time.sleep(0.1)
        if playing.returncode or playing.stdout is None:
            sys.exit('The bag could not be played.')
        return dict(json.loads(playing.stdout.read()))


def save_map() -> dict[str, str]:
    """Ask the node to save its map, as `ros2 service call` would; return its answer."""
    import rclpy
    from std_srvs.srv import Trigger

    print('$ ros2 service call /surfel_mapper/save_map std_srvs/srv/Trigger', flush=True)
    rclpy.init()
    asking = rclpy.create_node('demo')
    client = asking.create_client(Trigger, '/surfel_mapper/save_map')
    if not client.wait_for_service(60.0):
        sys.exit('The node does not answer.')
    for _ in range(6):  # the first answers are lost until the node has discovered this client
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(asking, future, timeout_sec=10.0)
        if future.done():
            break
    answer = future.result()
    asking.destroy_node()
    rclpy.shutdown()
    if answer is None or not answer.success:
        sys.exit(f'The map could not be saved: {answer.message if answer else "no answer"}')
    found = re.search(r'\((?P<received>\d+) received\), digest (?P<digest>\w+)', answer.message)
    if found is None:
        sys.exit(f'An answer without digest: {answer.message}')
    return found.groupdict()


if __name__ == '__main__':
    sys.exit(main())
