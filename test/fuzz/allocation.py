# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Replays in which one allocation of Python fails, in processes that end with them.

``one``: a whole replay with its imports, in this process; exit code 0 if it did not fail. Not
forked: threads that share the work of a scan would be missing in a child.

``until_the_map``: the allocations of a stride of a small replay by one thread fail once each,
from opening the bag to the map that is written. Imports are done and kernels loaded before;
children that are forked from there try a batch each. A child that dies ends its batch: numba dies
if it cannot allocate, and NumPy (2.3) fills an index without end. Prints the counts as JSON.
"""

from __future__ import annotations

import _testcapi
import faulthandler
import gc
import itertools
import json
import logging
import os
from pathlib import Path
import shutil
import signal
import sys
from typing import Any

from surfel_mapper import replay
from surfel_mapper.config import Config
from surfel_mapper.files.map_state import load_map
from surfel_mapper.offline.replay import ReplayOptions

SETTINGS = {'map.threads': 1, 'pose.source': 'identity'}
BATCH, SMALL_BATCH = 50, 5
"""Failures a process, all or a stride of them: forking takes as long as a failing replay."""

HANGS_S = 20
"""Processor time of a replay after which its process is ended; it takes .1 s."""

WHOLE, LEAST = 200, 5
"""Allocations in a row, and tried ones, after which a map is left: those before it are through."""

FAILED, DONE, WRITTEN, WRONG = b'fdwx'
"""Results of a replay: no map, no error, an error after the map was written, another map."""


def one(number: str, bag: str, output: str) -> int:
    """Let an allocation fail; return 0 if the replay succeeded, and 1 if it raised."""
    _testcapi.set_nomemory(int(number), int(number) + 1)
    try:
        replay(bag, output=output)
    except BaseException:
        return 1
    finally:
        _testcapi.remove_mem_hooks()
    return 0


def until_the_map(first: str, stride: str, bag: str, folder: str) -> int:
    """Let allocations fail in turn; return 1 if a map or a file was not as it has to be."""
    for number in range(3):
        expected = small_replay(bag, Path(folder, f'warm{number}'))
    gc.collect()
    gc.freeze()
    counts: dict[str, Any] = {'failed': 0, 'crashed': [], 'hung': [], 'last': 0}
    written, numbers = 0, itertools.count(int(first), int(stride))
    size = BATCH if int(stride) < BATCH else SMALL_BATCH
    batch = list(itertools.islice(numbers, size))
    while written < max(WHOLE // int(stride), LEAST):
        results, code = in_child(batch, bag, folder, expected)
        counts['failed'] += results.count(FAILED) + results.count(WRITTEN)
        if WRONG in results or code not in (0, -signal.SIGSEGV, -signal.SIGVTALRM):
            print(
                f'allocation {batch[len(results) - 1]}: {results[-1:]!r}, {code}', file=sys.stderr
            )
            return 1
        for result in results:
            written = 0 if result == FAILED else written + 1
        if code:
            ended = counts['crashed' if code == -signal.SIGSEGV else 'hung']
            ended.append(batch[len(results)])
            print(
                f'allocation {batch[len(results)]}: {signal.Signals(-code).name}', file=sys.stderr
            )
            results += bytes(1)
        counts['last'] = batch[len(results) - 1]
        batch = batch[len(results) :]
        batch += itertools.islice(numbers, size - len(batch))
    print(json.dumps(counts))
    return 0


def in_child(batch: list[int], bag: str, folder: str, expected: str) -> tuple[bytes, int]:
    """Return the results of a batch, as far as a child came, and its exit code."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        faulthandler.enable()
        faulthandler.register(signal.SIGVTALRM, chain=True)
        try:
            for number in batch:
                signal.setitimer(signal.ITIMER_VIRTUAL, HANGS_S)
                os.write(writing, bytes([result_of(number, bag, folder, expected)]))
        finally:
            os._exit(0)
    os.close(writing)
    with open(reading, 'rb') as pipe:
        results = pipe.read()
    return results, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def result_of(number: int, bag: str, folder: str, expected: str) -> int:
    """Return the result of a replay in which an allocation fails."""
    output, result = Path(folder, 'out'), DONE
    shutil.rmtree(output, ignore_errors=True)
    _testcapi.set_nomemory(number, number + 1)
    try:
        small_replay(bag, output)
    except BaseException:
        result = FAILED
    finally:
        _testcapi.remove_mem_hooks()
    gc.collect()  # a writer in a cycle with its traceback removes its file when it is collected
    if [*output.rglob('*.part')]:
        return WRONG
    if (output / 'map.npz').is_file():
        is_whole = load_map(output / 'map.npz')[0].digest() == expected
        result = WRONG if not is_whole else WRITTEN if result == FAILED else DONE
    return result


def small_replay(bag: str, output: Path) -> str:
    """Map a bag by one thread, and write the exact map; return its digest."""
    config = Config.from_mapping(SETTINGS)
    options = ReplayOptions(formats=('npz',))
    return replay(bag, config=config, output=output, options=options).mapper.map.digest()


if __name__ == '__main__':
    logging.disable(logging.CRITICAL)
    sys.exit({'one': one, 'until_the_map': until_the_map}[sys.argv[1]](*sys.argv[2:]))
