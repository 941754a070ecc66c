# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line lists its verbs, turns errors into messages, and loads few modules."""

from importlib import import_module
import os
from pathlib import Path
import subprocess
import sys

import pytest

import surfel_mapper
from surfel_mapper.cli import replay
from surfel_mapper.cli.main import main, VERBS
from surfel_mapper.errors import BagError
from test.bags.recorded import drive, write_rosbag2


def usage_code(*arguments):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    return stopped.value.code


def test_the_version_is_that_of_the_package(capsys):
    assert usage_code('--version') == 0
    assert capsys.readouterr().out == f'surfel-mapper {surfel_mapper.__version__}\n'


def test_help_lists_every_verb_with_its_summary(capsys):
    assert usage_code('--help') == 0
    text = ' '.join(capsys.readouterr().out.split())
    for verb in VERBS:
        assert f'{verb} {import_module(f"surfel_mapper.cli.{verb}").SUMMARY}' in text


def test_no_arguments_list_every_verb_with_its_summary(capsys):
    assert usage_code() == 2
    text = ' '.join(capsys.readouterr().err.split())
    for verb in VERBS:
        assert f'{verb} {import_module(f"surfel_mapper.cli.{verb}").SUMMARY}' in text


@pytest.mark.parametrize('verb', VERBS)
def test_a_misspelt_option_is_refused_before_arguments_are_missed(verb, capsys):
    assert usage_code(verb, '--hepl') == 2
    assert 'no option --hepl, did you mean --help?' in capsys.readouterr().err


def test_every_module_that_is_a_verb_is_listed():
    folder = Path(surfel_mapper.__file__).parent / 'cli'
    names = [path.stem for path in folder.glob('*.py') if path.stem != '__init__']
    modules = {name: import_module(f'surfel_mapper.cli.{name}') for name in names}
    assert {name for name in names if hasattr(modules[name], 'EXAMPLE')} == set(VERBS)


@pytest.mark.parametrize('verb', VERBS)
def test_the_help_of_a_verb_shows_an_example(verb, capsys):
    example = import_module(f'surfel_mapper.cli.{verb}').EXAMPLE

    assert usage_code(verb, '--help') == 0
    assert f'example:\n  {example}' in capsys.readouterr().out
    assert example.startswith(f'surfel-mapper {verb} ')


@pytest.mark.parametrize('arguments', [(), ('fly',), ('replay',), ('replay', 'a', '--fly')])
def test_wrong_usage_exits_with_2_and_a_hint(arguments, capsys):
    assert usage_code(*arguments) == 2
    assert 'usage: surfel-mapper' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('arguments', 'says'),
    [
        (('repaly', 'a'), "no verb 'repaly', did you mean replay?"),
        (('fly',), "no verb 'fly'; verbs: node, replay"),
        (('replay', 'a', '--ouptut', 'b'), 'no option --ouptut, did you mean --output?'),
        (('replay', 'a', '--poses-from', 'identiy'), ', did you mean identity?'),
        (('replay', 'a', '--seconds', '3'), 'error: no option --seconds\n'),
        (('extract', '--voxl-size=0.2'), 'no option --voxl-size, did you mean --voxel-size?'),
        (('merge', 'a', '-output=b'), 'no option -output, did you mean --output?'),
        (('replay', 'a', '--po', 'b'), 'ambiguous option: --po could match --pose-topic, '),
        (('info', 'a', 'b'), 'too many arguments: b'),
        (('merge', 'a', '--output', 'b', '--min-points', '0'), 'a whole number of 1 or more'),
        (('view', 'a', '--at', '1', '2', 'nan'), "--at: 'nan', expected a finite number"),
        (('view', 'a', '--port', '0'), "--port: '0', expected a whole number of 1 or more"),
        (('view', 'a', '--port', '65535'), "--port: '65535', expected a port up to 65534"),
    ],
)
def test_a_mistyped_word_is_answered_with_the_nearest(arguments, says, capsys):
    assert usage_code(*arguments) == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ('error', 'code', 'says'),
    [
        (BagError('a.bag: odd'), 1, 'surfel-mapper replay: a.bag: odd\n'),
        (OSError(28, 'No space left', 'a.ply'), 1, 'surfel-mapper replay: a.ply: No space left'),
        (KeyboardInterrupt(), 130, 'surfel-mapper replay: interrupted\n'),
    ],
)
def test_errors_become_messages_and_exit_codes(error, code, says, monkeypatch, capsys):
    def fails(args):
        raise error

    monkeypatch.setattr(replay, 'run', fails)

    assert main(['replay', 'a.bag']) == code
    printed = capsys.readouterr()
    assert says in printed.err
    assert 'Traceback' not in printed.err
    assert printed.out == ''


def test_mistakes_of_our_own_keep_their_traceback(monkeypatch):
    monkeypatch.setattr(replay, 'run', lambda args: 1 / 0)

    with pytest.raises(ZeroDivisionError):
        main(['replay', 'a.bag'])


def test_arguments_after_ros_args_are_not_read_as_options(monkeypatch):
    seen = []
    monkeypatch.setattr(replay, 'run', lambda args: seen.append(args) or 0)

    assert main(['replay', 'a.bag', '--ros-args', '-r', '__node:=x']) == 0
    assert seen[0].ros_args == ['--ros-args', '-r', '__node:=x']


@pytest.mark.parametrize('arguments', [['--help'], ['replay', '--help'], ['info', '/no/bag']])
def test_help_and_refusals_load_nothing_heavy(arguments):
    program = (
        'import sys\n'
        'from surfel_mapper.cli.main import main\n'
        'try:\n'
        f'    main({arguments!r})\n'
        'except SystemExit:\n'
        '    pass\n'
        "heavy = {'numba', 'matplotlib', 'rclpy', 'scipy', 'rosbags.typesys'}\n"
        'print(sorted(heavy & set(sys.modules)), file=sys.stderr)\n'
    )

    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True)

    assert done.stderr.splitlines()[-1] == '[]'


def test_a_closed_pipe_is_no_error(tmp_path):
    bag = write_rosbag2(tmp_path / 'drive', drive())
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, '-m', 'surfel_mapper.cli.main', 'info', str(bag)]
    try:
        done = subprocess.run(command, stdout=write_end, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(write_end)

    assert (done.returncode, done.stderr) == (0, '')
