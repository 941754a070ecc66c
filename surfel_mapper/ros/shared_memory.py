# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Shared memory of Fast DDS that holds clouds.

By default it is half a megabyte, and whatever is larger goes out in fragments over UDP: of
best-effort clouds of 4 MiB at most 3 % arrived, with the profile beside this file all. It matters
to whoever publishes, and has to be set before rclpy is initialised.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

PROFILE = Path(__file__).with_name('fastdds_shm.xml')

OWN_SETTINGS = (
    'FASTDDS_BUILTIN_TRANSPORTS',
    'FASTDDS_DEFAULT_PROFILES_FILE',
    'FASTRTPS_DEFAULT_PROFILES_FILE',
)
"""Variables by which a user configures Fast DDS; where one is set, we leave it at that."""

NEEDED_BYTES = 80 << 20
"""The segment of the profile and some room."""

log = logging.getLogger(__name__)


def enlarge_shared_memory() -> None:
    """Give Fast DDS the profile, unless the user has configured it or there is no room."""
    if any(os.environ.get(name) for name in OWN_SETTINGS):
        return
    try:
        system = os.statvfs('/dev/shm')
    except OSError:
        return  # not Linux: no shared memory of this kind
    free = system.f_bavail * system.f_frsize
    if free < NEEDED_BYTES:
        log.warning(
            '/dev/shm has %d MB free, too few for large clouds in shared memory (%d MB); some may '
            'be lost. In a container enlarge it (docker run --shm-size 256m)',
            free >> 20,
            NEEDED_BYTES >> 20,
        )
        return
    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
    os.environ['FASTDDS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
