# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A ROS domain for one run of tests or of a bench; in a module of its own, needs no ROS."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import itertools
import os
import socket
from unittest import mock


@contextmanager
def domain_of_our_own() -> Iterator[None]:
    """
    Keep ROS traffic on this machine, in a domain that no other run uses, in a with-block.

    A domain is claimed by a socket of its name, which ends with the process; examples/demo.py
    claims its own likewise.
    """
    for number in itertools.chain(range(os.getpid() % 100, 100), range(100)):
        with socket.socket(socket.AF_UNIX) as claim:
            try:
                claim.bind(f'\0surfel_mapper-ros-domain-{number + 1}')
            except OSError:  # taken
                continue
            own = {
                'ROS_DOMAIN_ID': str(number + 1),
                'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            }
            with mock.patch.dict(os.environ, own):
                yield
            return
    raise OSError('all 100 ROS domains of tests are taken: end other runs')
