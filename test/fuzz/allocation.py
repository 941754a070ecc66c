# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A replay in which one allocation of Python fails, in a process that ends with it.

``python -m test.fuzz.allocation NUMBER BAG OUTPUT``: exit code 0 if the replay did not fail. Not
forked: threads that share the work of a scan would be missing in a child.
"""

from __future__ import annotations

import _testcapi
import logging
import sys

from surfel_mapper import replay


def main(number: str, bag: str, output: str) -> int:
    """Let an allocation fail; return 0 if the replay succeeded, and 1 if it raised."""
    logging.disable(logging.CRITICAL)
    _testcapi.set_nomemory(int(number), int(number) + 1)
    try:
        replay(bag, output=output)
    except BaseException:
        return 1
    finally:
        _testcapi.remove_mem_hooks()
    return 0


if __name__ == '__main__':
    sys.exit(main(*sys.argv[1:]))
