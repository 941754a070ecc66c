# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``--open``: the result in a browser.

A verb is done before its result is opened. On a machine without a display or a browser a message
names the reason, and the exit code stays.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
import sys

from surfel_mapper.cli._output import show_lines
from surfel_mapper.errors import escaped

DISPLAYS = ('DISPLAY', 'WAYLAND_DISPLAY')
"""Variables of the environment that name a display."""


def add_open(parser: argparse._ActionsContainer, name: str) -> None:
    """Declare the option for a verb that writes a file of this name to be looked at."""
    parser.add_argument(
        '--open', action='store_true', help=f'open {name} in the browser at the end'
    )


def has_display() -> bool:
    """Return whether windows can be opened."""
    return sys.platform != 'linux' or any(map(os.environ.get, DISPLAYS))


def open_file(path: Path) -> None:
    """Open a file in the browser; print the reason on stderr if that is not possible."""
    if reason := failure(path.resolve().as_uri()):
        text = escaped(f'surfel-mapper: {path} cannot be opened here: {reason}')
        show_lines(text, to_stderr=True)


def failure(address: str) -> str:
    """Open an address in the browser; return why that failed, empty if it did not."""
    import webbrowser

    if not has_display() and not os.environ.get('BROWSER'):  # else text browsers would be started
        return f'no display ({" or ".join(DISPLAYS)}), and no BROWSER'
    try:
        return '' if webbrowser.open(address) else 'no browser'
    except (OSError, webbrowser.Error) as error:
        return f'no browser ({error})'
