# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C ends the command without a traceback, also while modules load and after the verb."""

import subprocess
import sys

import pytest

PRESS = """
import atexit, os, signal, sys

moment = sys.argv.pop(1)
signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever the test run ignores
press = lambda: os.kill(os.getpid(), signal.SIGINT)

class Import:
    def find_spec(self, name, path=None, target=None):
        if name == moment:
            press()

if moment == 'exit':
    atexit.register(press)
sys.meta_path.insert(0, Import())
if moment == 'ignored':
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    atexit.register(press)
from surfel_mapper.cli.start import main
sys.exit(main())
"""


def run(moment, *arguments):
    command = [sys.executable, '-c', PRESS, moment, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize(
    'moment',
    ['surfel_mapper.cli.main', 'surfel_mapper.cli.info', 'surfel_mapper.offline.survey', 'exit'],
)
def test_ctrl_c_ends_the_command_without_a_traceback(moment, tmp_path):
    arguments = ['filters'] if moment == 'exit' else ['info', str(tmp_path)]
    done = run(moment, *arguments)
    assert (done.returncode, 'Traceback' in done.stderr) == (130, False), done.stderr
    assert done.stderr.endswith('interrupted\n')


def test_ctrl_c_that_the_caller_ignores_stays_ignored():
    done = run('ignored', 'filters')
    assert (done.returncode, done.stderr) == (0, '')
    assert 'SurfaceNormal' in done.stdout


def test_the_exit_code_of_a_verb_is_kept():
    assert run('never', 'filters').returncode == 0
    assert run('never', 'info', 'missing.bag').returncode == 1
