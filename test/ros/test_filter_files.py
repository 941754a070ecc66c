# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The files of filters that a peer may name, and refusals without text of a file."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from rclpy.parameter import Parameter

from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError
from surfel_mapper.ros.filter_files import check_chain, FilterFiles
from test.ros.driving import ARGUMENTS

SECRET = 'root:$6$hunter2'


def files_in(directory, first=''):
    settings = {'input.filters_directory': str(directory), 'filters': first}
    return FilterFiles(Config.from_mapping(settings), [])


def test_names_are_of_the_directory_and_the_chain_of_the_start_may_be_anywhere(tmp_path):
    files = files_in(tmp_path, first='/etc/chain.yaml#near')
    assert files.path('near.yaml#a.b') == f'{tmp_path}/near.yaml#a.b'
    assert files.path(f'{tmp_path}/sub/far.yaml') == f'{tmp_path}/sub/far.yaml'
    assert files.path('/etc/chain.yaml#near') == '/etc/chain.yaml#near'
    assert files.path('') == ''


def test_names_outside_of_the_directory_are_refused(tmp_path):
    directory = tmp_path / 'chains'
    directory.mkdir()
    (tmp_path / 'shadow').write_text(SECRET)
    (directory / 'link').symlink_to(tmp_path / 'shadow')
    for name in ('../shadow', '/etc/passwd', 'link', str(tmp_path / 'shadow'), 'a\0b', 'x' * 5000):
        with pytest.raises(ConfigError, match=f'is not inside {directory}'):
            files_in(directory).path(name)


def test_the_directory_is_by_default_that_of_the_first_parameter_file(tmp_path):
    arguments = ['--ros-args', '--params-file', f'{tmp_path}/robot.yaml', '--params-file', '/x/y']
    assert FilterFiles(Config(), arguments).path('near.yaml') == f'{tmp_path}/near.yaml'
    with pytest.raises(ConfigError, match='give the directory of chains at the start'):
        FilterFiles(Config(), ['--ros-args']).path('near.yaml')


@pytest.mark.parametrize(
    ('content', 'kind'),
    [
        (SECRET, 'no valid chain'),
        (f'- {SECRET.partition(":")[2]}', 'no valid chain'),
        (f'- {SECRET}: 1', 'no valid chain'),
        (f'- MaxDistDataPointsFilter: {{maxDist: {SECRET}}}', 'no valid chain'),
        (f'"{SECRET}', 'not YAML'),
        (f'- *{SECRET}', 'not YAML'),
        (f'{SECRET}: [1]\n{SECRET}: 2', 'no valid chain'),
        (None, 'cannot be read: No such file'),
    ],
)
def test_a_refusal_has_the_kind_of_fault_and_no_text_of_the_file(tmp_path, content, kind):
    path = tmp_path / 'chain.yaml'
    if content is not None:
        path.write_text(content)
    with pytest.raises(ConfigError) as refused:
        check_chain(f'{path}#key' if content and content.endswith('2') else str(path))
    assert kind in str(refused.value)
    assert str(path) in str(refused.value)
    assert 'hunter2' not in str(refused.value)


def test_no_text_of_a_file_reaches_an_answer_or_the_log(start, peer, tmp_path):
    (tmp_path / 'shadow').write_text(SECRET)
    node = start('node', *ARGUMENTS, '-p', f'input.filters_directory:={tmp_path}')
    client = peer.parameters()
    for name in ('shadow', '/etc/passwd'):
        asked = client.set_parameters([Parameter('filters', value=name)])
        (answer,) = peer.result(asked).results
        assert not answer.successful
        assert 'hunter2' not in answer.reason
    assert 'hunter2' not in node.output
