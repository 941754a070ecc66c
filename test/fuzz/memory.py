# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Resident memory of this process, for the tests that bound it; asked for 60,000 times a run."""

import contextlib
import re


def resident(what):
    """Return the resident memory (VmRSS) or its peak (VmHWM), bytes; 0 if /proc is missing."""
    try:
        with open('/proc/self/status', 'rb', buffering=0) as file:
            found = re.search(rf'{what}:\s*(\d+)'.encode(), file.read())
    except OSError:
        return 0
    return int(found[1]) << 10 if found else 0


def reset_peak():
    """Let the peak (VmHWM) begin at the memory in use."""
    with (
        contextlib.suppress(OSError),
        open('/proc/self/clear_refs', 'wb', buffering=0) as file,
    ):
        file.write(b'5')
