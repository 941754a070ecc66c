# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Resident memory of this process, for the tests that bound it."""

import contextlib
from pathlib import Path


def resident(what):
    """Return the resident memory (VmRSS) or its peak (VmHWM), bytes; 0 if /proc is missing."""
    try:
        lines = Path('/proc/self/status').read_text(encoding='ascii').splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) << 10 for line in lines if line.startswith(what)), 0)


def reset_peak():
    """Let the peak (VmHWM) begin at the memory in use."""
    with contextlib.suppress(OSError):
        Path('/proc/self/clear_refs').write_text('5', encoding='ascii')
