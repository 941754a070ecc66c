# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper node`` and ``play`` without ROS 2; test/ros/ runs them with it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from surfel_mapper.cli.main import main
from test.bags.recorded import drive, write_rosbag2

WITHOUT_ROS = """
import sys
sys.modules['rclpy'] = None  # as if it were not installed
from surfel_mapper.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize('verb', ['node', 'play'])
def test_without_ros_the_error_says_how_to_install_it(tmp_path, verb):
    words = [verb] if verb == 'node' else [verb, str(write_rosbag2(tmp_path / 'bag', drive()))]
    done = subprocess.run(
        [sys.executable, '-c', WITHOUT_ROS, *words], capture_output=True, text=True
    )
    assert done.returncode == 1
    assert done.stderr.startswith(f'surfel-mapper {verb}: ROS 2 cannot be loaded (')
    assert "pip install 'surfel_mapper[ros]'" in done.stderr
    assert 'source /opt/ros/jazzy/setup.bash' in done.stderr
    assert 'Traceback' not in done.stderr


@pytest.mark.parametrize('rate', ['0', '-1', 'nan'])
def test_an_invalid_pace_is_refused(tmp_path, capsys, rate):
    with pytest.raises(SystemExit) as stopped:
        main(['play', str(write_rosbag2(tmp_path / 'bag', drive())), '--rate', rate])
    assert stopped.value.code == 2
    assert 'expected a positive number' in capsys.readouterr().err
