# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Tables of docs/faults.md and SECURITY.md from runs and tests, limits from the code.

``python -m test.fuzz --seconds 600 > fuzz.log`` and then ``python -m test.fuzz.claims fuzz.log``
write them: faults, findings and numbers of inputs from the tests, costs from the log of one or
several runs, the last row of an input counts. Logs of ``test.soak``, ``test.soak.faults 10`` and
``test.soak.node_faults 10`` give the rows of long runs, and logs of all shares of
``test_failures.py``, from ``test.fuzz`` or pytest -rP, those of kills and failed allocations; the
last log of a share counts. The limits that SECURITY.md states are
compared with the constants of the code; the command lists those that differ, and a test fails.
"""

from __future__ import annotations

import json
from pathlib import Path
import re
import sys
from typing import NamedTuple

from surfel_mapper import budget
from surfel_mapper.bags import _rosbags, bag_file, chunked, compression, decoders, paths
from surfel_mapper.config import yaml_files
from surfel_mapper.geometry import MAX_TRANSLATION_M
from surfel_mapper.messages.pointcloud2 import MAX_FIELDS
from surfel_mapper.offline import pcap_packets
from surfel_mapper.poses import buffer
from test.fuzz import findings_table, oracle
from test.fuzz.__main__ import HEAD
from test.fuzz.harnesses import HARNESSES
from test.fuzz.test_failures import FEWER, SHARES
from test.ros import fault_table

SECURITY = fault_table.PAGE.parents[1] / 'SECURITY.md'

BEGIN, END = '<!-- begin: costs from runs of test.fuzz -->', '<!-- end: costs -->'

TOTAL = '| inputs of `make fuzz`, by atheris and then measured |'

RUN = re.compile(r'^\| `python -m test\.soak.*\|$', re.MULTILINE)

ROW = re.compile(r'^\| (\w+) \| (\d+) \| (\d+) \|.*\|$', re.MULTILINE)


SHARE = re.compile(r'^share (\d+)\b', re.MULTILINE)

FAILED = re.compile(
    r'^(\w+): (\d+) allocations failed(?:, (\d+) in a call of numba)?', re.MULTILINE
)

UNTIL_THE_MAP = re.compile(r'^replay up to its map: (\{.*?\})', re.MULTILINE)

KILLED = re.compile(r'^killed at (\d+) steps of writing$', re.MULTILINE)

KILLS = '| steps of writing where the process was killed, by `make fuzz` and in the rows below |'

OF_THE_MAP = '| allocations of insert, remove, reduce, read and load that failed, each of them |'

OF_A_REPLAY = '| allocations of a small replay up to its map that failed, each of them |'

SAMPLED = '| allocations of a replay with its imports and threads that failed, sampled |'


def limits() -> list[str]:
    """Return the limits of readers as SECURITY.md has to state them."""
    packets = pcap_packets
    pixels, columns = (
        packets.MOST[f'{name}'] for name in ('pixels_per_column', 'columns_per_frame')
    )
    return [
        f'{budget.FLOOR_BYTES >> 20} MiB or {budget.BYTES_PER_BYTE} bytes per byte of\ninput',
        f'`{budget.VARIABLE}`',
        f'{MAX_FIELDS:,} at most',
        f'{budget.FLOOR_BYTES >> 20} MiB or {budget.BYTES_PER_BYTE} times the file, '
        f'{compression.MAX_UNPACKED_BYTES >> 20} MiB at most',
        f'all together {compression.FLOOR_BYTES >> 20} MiB '
        f'(bz2: {compression.SLOW_FLOOR_BYTES >> 20}) or '
        f'{compression.MAX_FILE_RATIO} times the file',
        f'({bag_file.MESSAGE_BYTES} bytes each)',
        f'{compression.MAX_FRAMES:,} frames of a packed file or one more per '
        f'{compression.LEAST_FRAME_BYTES >> 10} KiB',
        f'{chunked.MAX_MESSAGES:,} messages or one per {chunked.LEAST_BYTES} bytes',
        f'{chunked.MAX_OTHERS:,} other records or one per {chunked.LEAST_OTHER_BYTES}',
        f'{chunked.MAX_CHUNKS:,} chunks or one per {chunked.LEAST_CHUNK_BYTES}',
        f'{bag_file.MAX_CONNECTIONS:,} topics',
        f'definitions that are parsed: {_rosbags.MAX_DEFINITION:,} characters each, '
        f'{decoders.MAX_DEFINED:,} and one per {decoders.BYTES_EACH} bytes together, and each '
        f'counts {decoders.LEAST_DEFINITION:,} more',
        f'{_rosbags.MAX_VALUES:,} values in a message of a type of ROS 1',
        f'{budget.FLOOR_S:.0f} s or {1e6 * budget.SECONDS_PER_BYTE:.0f} us per byte of processor'
        ' time',
        f'nesting of {yaml_files.MAX_DEPTH}; {yaml_files.MAX_NODES:,} nodes '
        f'(metadata.yaml: {paths.MAX_NODES:,}, and {paths.MAX_FILES:,} files)',
        f'{packets.MAX_PENDING:,} unfinished fragments; {packets.MAX_PACKETS:,} packets or one '
        f'per {packets.LEAST_BYTES} bytes; sizes in the metadata: {pixels:,} x {columns:,} pixels',
        f'rigid transforms within {MAX_TRANSLATION_M:.0e} m'.replace('e+0', 'e'),
        f'{buffer.MAX_EDGES:,} frames of',
        f'{buffer.MAX_DEPTH} from a frame to its root',
        f'within {oracle.MOST_BYTES >> 20} MiB and\n{oracle.MOST_RATIO} bytes per byte, and '
        f'{oracle.MOST_S} s and {1e9 * oracle.MOST_S_PER_BYTE:.0f} ns per byte of processor time',
    ]


def page_with_runs(text: str, logs: str) -> str:
    """Return the page with the rows of long runs in logs, in place of earlier rows of theirs."""
    for row in RUN.findall(logs):
        command = row.split('|')[1]
        if f'|{command}|' not in text:
            raise SystemExit(f'{fault_table.PAGE.name} has no row of{command}')
        text = re.sub(
            rf'^\|{re.escape(command)}\|.*$', lambda _, r=row: r, text, flags=re.MULTILINE
        )
    return text


class Failures(NamedTuple):
    """Allocations that failed in logs of all shares, and those that ended or stalled a process."""

    of_the_map: int
    crashed: int
    of_a_replay: int
    ended: int
    sampled: int

    @classmethod
    def of(cls, logs: str) -> Failures:
        """Add up the shares; those of the map and of samples come again after FEWER shares."""
        _, *parts = SHARE.split(logs)
        found: dict[int, str] = {}
        for share, text in zip(map(int, parts[::2]), parts[1::2], strict=True):
            if UNTIL_THE_MAP.search(text):
                found.pop(share, None)  # the order of the logs decides below too
                found[share] = text
        missing = set(range(SHARES)) - found.keys()
        if missing:
            raise SystemExit(f'no log of share {", ".join(map(str, sorted(missing)))}')
        replays = [
            json.loads(UNTIL_THE_MAP.search(text)[1].replace("'", '"'))
            for _, text in sorted(found.items())
        ]
        distinct = {share % FEWER: text for share, text in found.items()}
        rows = [row for text in distinct.values() for row in FAILED.findall(text)]
        return cls(
            of_the_map=sum(int(number) for name, number, _ in rows if name != 'replay'),
            crashed=sum(
                int(number or 0) for text in found.values() for *_, number in FAILED.findall(text)
            ),
            of_a_replay=sum(counts['failed'] for counts in replays),
            ended=sum(len(counts['crashed']) + len(counts['hung']) for counts in replays),
            sampled=sum(int(number) for name, number, _ in rows if name == 'replay'),
        )


def page_with_failures(text: str, logs: str) -> str:
    """Return the page with the rows of failed allocations and of kills that logs have."""
    rows = {}
    if SHARE.search(logs):
        found = Failures.of(logs)
        ended = f'{found.crashed or "none"} ended the process'
        rows[OF_THE_MAP] = f'{found.of_the_map:,} | the map is that before or after; {ended} |'
        ended = f'{found.ended or "none"} ended or stalled the process'
        rows[OF_A_REPLAY] = f'{found.of_a_replay:,} | the whole map or none; {ended} |'
        rows[SAMPLED] = f'{found.sampled:,} | the same |'
    if killed := KILLED.findall(logs):
        rows[KILLS] = f'{int(killed[-1]):,} and {kills_of_tests()} | incomplete files: 0 |'
    for row, cells in rows.items():
        if row not in text:
            raise SystemExit(f'{fault_table.PAGE.name} has no row of{row.strip("|")}')
        text = re.sub(
            rf'^{re.escape(row)}.*$', lambda _, r=f'{row} {cells}': r, text, flags=re.MULTILINE
        )
    return text


def kills_of_tests() -> int:
    """Return the steps at which tests of test/ros kill a process that saves, and a replay."""
    from test.ros import test_faults_files as tests

    return tests.STEPS_OF_SAVING * len(tests.SIGNALS) + tests.STEPS_OF_REPLAY


def security_page() -> str:
    """Return SECURITY.md with the table of findings."""
    before, _, rest = SECURITY.read_text(encoding='utf-8').partition(findings_table.BEGIN)
    return before + findings_table.table() + rest.partition(findings_table.END)[2]


def false_limits() -> list[str]:
    """Return the limits that SECURITY.md does not state."""
    text = ' '.join(SECURITY.read_text(encoding='utf-8').split())
    return [limit for limit in limits() if ' '.join(limit.split()) not in text]


def costs() -> dict[str, tuple[int, int]]:
    """Return the inputs that the page states, by harness: by atheris, and measured."""
    table = fault_table.PAGE.read_text(encoding='utf-8').partition(BEGIN)[2].partition(END)[0]
    return {name: (int(tried), int(measured)) for name, tried, measured in ROW.findall(table)}


def page_with_costs(text: str, logs: str) -> str:
    """Return the page with the table of costs, and its total, from the output of runs."""
    rows = {found[1]: found[0] for found in ROW.finditer(logs)}
    missing = HARNESSES.keys() - rows.keys()
    if missing:
        raise SystemExit(f'no row of {", ".join(sorted(missing))}: broken, or not searched')
    before, _, rest = text.partition(BEGIN)
    table = '\n'.join([BEGIN, *HEAD, *(rows[name] for name in HARNESSES), END])
    text = before + table + rest.partition(END)[2]
    sums = (sum(int(ROW.match(rows[name])[at]) for name in HARNESSES) for at in (2, 3))
    total = ' and '.join(f'{number:,}' for number in sums)
    return re.sub(rf'(?<=^{re.escape(TOTAL)} )[\d, and]+', f'{total} ', text, flags=re.MULTILINE)


def main(*logs: str) -> int:
    """Write the tables; print the limits that SECURITY.md lacks, and return their number."""
    text = fault_table.page_with(fault_table.table())
    output = '\n'.join(Path(log).read_text('utf-8') for log in logs)
    text = page_with_failures(page_with_runs(text, output), output)
    if HEAD[0] in output:
        text = page_with_costs(text, output)
    fault_table.PAGE.write_text(text, encoding='utf-8')
    SECURITY.write_text(security_page(), encoding='utf-8')
    false = false_limits()
    for limit in false:
        print(f'SECURITY.md does not state: {limit}')
    return len(false)


if __name__ == '__main__':
    sys.exit(main(*sys.argv[1:]))
