# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Entry point of the command ``surfel-mapper``: Ctrl-C ends it without a traceback at any time.

Modules load for some tenths of a second before a verb can handle signals, and Python ends threads
after it. In both spans there is nothing to save, and the process ends at once.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

INTERRUPTED = 130


def end_at_once(_number: int, _frame: FrameType | None) -> None:
    """End the process, with the exit code of an interruption."""
    os.write(2, b'surfel-mapper: interrupted\n')
    os._exit(INTERRUPTED)


def main() -> int:
    """Run the command line and return its exit code."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        from surfel_mapper.cli.main import main  # the caller ignores Ctrl-C, as nohup does

        return main()
    signal.signal(signal.SIGINT, end_at_once)
    from surfel_mapper.cli.main import main

    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        code = main()
        signal.signal(signal.SIGINT, end_at_once)
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, end_at_once)
        print('surfel-mapper: interrupted', file=sys.stderr)
        code = INTERRUPTED
    return code


if __name__ == '__main__':
    sys.exit(main())
