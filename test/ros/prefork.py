# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Verbs as processes that are forked from one which has loaded all modules and kernels.

A node needs 2 s of processor time to load numba, rclpy and its kernels, and the tests start more
than a hundred. A fork needs a tenth of that, and is otherwise the same process: nothing that was
loaded has a thread, a ROS context or an open file. Its parent exits at once, so that it becomes
a child of the test run, which waits for it. Linux only; elsewhere each verb gets a
new Python.

`python -m test.ros.prefork SOCKET` is the process that forks.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import threading
import time

ROOT = Path(__file__).parents[2]

LAYERS = {
    'pose.source': 'odometry',
    'deskew.enabled': True,
    'publish.levels': 1,
    'map.intensity': True,
    'window.keep_points': True,
    'layers.tsdf.enabled': True,
    'layers.models.enabled': True,
}
WITHOUT_POSES = {'pose.source': 'registration'}

ONE_THREAD = {'layers.tsdf.threads': 1}
"""No pool of threads is left in the process that forks."""

VERBS = ('node', 'play', 'replay')
LONGEST_REQUEST = 1 << 20
PR_SET_CHILD_SUBREAPER = 36
POLL_S = 0.01


class Prefork:
    """The process that forks, until `close`."""

    def __init__(self):
        """Start it; return when all is loaded and compiled, a minute if nothing is cached."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            libc = ctypes.CDLL(None, use_errno=True)
            if libc.prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0):
                raise OSError(ctypes.get_errno(), 'no subreaper')
            self._process = subprocess.Popen(
                [sys.executable, '-m', 'test.ros.prefork', str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                cwd=ROOT,
            )
        self._socket = ours
        self._answer()

    def start(self, arguments, output, folder, environment):
        """Run a verb in a folder, its output into a file; return its process."""
        request = [list(map(str, arguments)), str(output), str(folder), environment]
        self._socket.send(json.dumps(request).encode())
        return Forked(int(self._answer()))

    def _answer(self):
        answer = self._socket.recv(64)
        if not answer:
            raise OSError('test.ros.prefork has ended; its error is above')
        return answer

    def close(self):
        self._socket.close()
        self._process.wait()


class Forked:
    """A forked process, used like a subprocess.Popen."""

    def __init__(self, pid):
        self.pid = pid
        self.returncode = None

    def poll(self):
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout):
        end = time.monotonic() + timeout
        while self.poll() is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired(f'process {self.pid}', timeout)
            time.sleep(POLL_S)
        return self.returncode

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)


def load():
    """Load the modules of the verbs, and compile or load the kernels of a node."""
    from importlib import import_module

    from rclpy.impl.rcutils_logger import CallerId

    from surfel_mapper.compilation import run_stages
    from surfel_mapper.pipeline import Mapper
    from surfel_mapper.pipeline.warm_up import node_stages
    from test.fields import config_of

    for name in (*(f'cli.{verb}' for verb in VERBS), 'ros.main', 'ros.player', 'offline.replay'):
        import_module(f'surfel_mapper.{name}')
    for settings in ({}, LAYERS, WITHOUT_POSES):
        config = config_of({'pose.source': 'odometry', **settings, **ONE_THREAD})
        run_stages(node_stages(Mapper(config)))
    load_type_supports()
    CallerId()  # of the first message of a log: finds the files of all modules, .05 s in each node
    if threading.active_count() > 1:
        raise RuntimeError(f'threads do not survive a fork: {threading.enumerate()}')
    gc.collect()
    gc.freeze()


def load_type_supports():
    """Load what rclpy otherwise loads with the first message of a type, .1 s in each node."""
    from rclpy.type_support import check_for_type_support

    for name in [name for name in sys.modules if name.endswith(('.msg', '.srv'))]:
        for kind in list(vars(sys.modules[name]).values()):
            if hasattr(type(kind), '__import_type_support__'):
                check_for_type_support(kind)


def serve(requests):
    """Fork a process for each request; return its arguments in there, None at the end."""
    while message := requests.recv(LONGEST_REQUEST):
        reading, writing = os.pipe()
        parent = os.fork()
        if parent:
            os.waitpid(parent, 0)  # only then is the new process a child of the test run
            requests.send(os.read(reading, 64))
            os.close(reading)
            os.close(writing)
            continue
        child = os.fork()
        if child:
            os.write(writing, str(child).encode())
            os._exit(0)
        os.close(reading)
        os.close(writing)
        arguments, output, folder, environment = json.loads(message)
        requests.close()
        file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(file, 1)
        os.dup2(file, 2)
        os.close(file)
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(environment)
        return arguments
    return None


def main(number):
    """Load everything, then run as the forked process that a request asks for."""
    requests = socket.socket(fileno=number)
    load()
    requests.send(b'loaded')
    arguments = serve(requests)
    if arguments is None:
        return 0
    from surfel_mapper.cli.main import main as verb

    sys.argv = ['surfel-mapper', *arguments]
    return verb(arguments)


if __name__ == '__main__':
    sys.exit(main(int(sys.argv[1])))
