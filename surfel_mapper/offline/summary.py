# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Text for people from the summary of a replay: a few lines for the terminal, parts of titles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

MOST_SURROUNDED = 5
"""Scans that may seem to be surrounded by what moves along, before a replay says so."""


def as_text(summary: Mapping[str, Any], written: Sequence[Path]) -> str:
    """
    Return the summary in a few lines for people.

    The times of the stages are those of the whole replay by scan received, in the thread that
    maps; ``other`` is the rest of the total, mostly the time to pass scans to a second thread.
    """
    from surfel_mapper.counters import STAGES  # loads numpy, which --help does not need

    scans, times = summary['scans'], summary['milliseconds']
    out = f' ({sum(scans["dropped"].values())} dropped: {causes_text(scans["dropped"])})'
    gated = f' ({scans["gated"]} left out by the motion gate)'
    localised = f' ({scans["localised"]} aligned to a frozen map)' if 'localised' in scans else ''
    slowest = times['total']['p99'] if 'total' in times else 0.0
    share = 1e3 / max(scans['received'], 1)
    means = {stage: s for stage, s in in_order(summary['stage_s'], STAGES) if stage != 'total'}
    means['other'] = summary['replay_s'] - sum(means.values())
    means['total'] = summary['replay_s']
    stages = '   '.join(f'{stage} {share * seconds:.1f} ms' for stage, seconds in means.items())
    filters = ''.join(
        f'{name}: {rounded(done["points_in"])} points in, {rounded(done["points_out"])} out, '
        f'{done["milliseconds"]["median"]:.1f} ms a scan\n'
        for name, done in summary['filters'].items()
    )
    aligned = ''.join(
        f'{summary[name]["text"]}\n' for name in ('loops', 'alignment') if name in summary
    )
    errors = f'{errors_text(summary["pose_errors"])}\n' if 'pose_errors' in summary else ''
    apart = uncertain_text(summary)
    speed = summary['recorded_s'] / summary['replay_s']
    deskewed = ', deskewed' if summary.get('deskewed') else ''
    poses = (
        f'poses from {summary["poses_from"]}{deskewed}: {summary["poses_reason"]}\n'
        if summary.get('poses_reason')
        else ''
    )
    return (
        f'{poses}'
        f'scans {scans["received"]}{out if scans["dropped"] else ""}'
        f'{gated if scans["gated"] else ""}{localised}   points {rounded(summary["points"])}   '
        f'surfels {summary["surfels"]}\n'
        f'{stages} a scan (p99 {slowest:.1f})   {speed:.1f} times real time\n'
        f'{filters}{aligned}{errors}{f"{apart}{chr(10)}" if apart else ""}'
        f'digest {summary["digest"]}\n'
        f'{"   ".join(str(path) for path in written)}'
    )


def in_order(values: Mapping[str, Any], names: Sequence[str]) -> list[tuple[str, Any]]:
    """Return items in the order of names; those of other names, of layers, at the end."""
    first = [name for name in names if name in values]
    return [(name, values[name]) for name in [*first, *(n for n in values if n not in first)]]


def uncertain_text(summary: Mapping[str, Any]) -> str:
    """Return which scans have no certain place on the map, and why; empty if there are none."""
    return '\n'.join(filter(None, (apart_text(summary), surrounded_text(summary))))


def surrounded_text(summary: Mapping[str, Any]) -> str:
    """Return how long most of the surroundings seemed to move along; empty if hardly."""
    found = summary.get('registration', {}).get('tracking', {}).get('surrounded')
    if found is None or found['scans'] < MOST_SURROUNDED:
        return ''
    return (
        f'in {found["scans"]} of {summary["scans"]["received"]} scans ({found["seconds"]:.1f} s) '
        'most of what is seen seems to move along with the sensor: their poses may be wrong'
    )


def apart_text(summary: Mapping[str, Any]) -> str:
    """Return the parts that stayed apart, and why; empty if there are none."""
    tracking = summary.get('registration', {})
    parts = tracking.get('apart', [])
    if not parts:
        return ''
    counted = summary['scans']['dropped'].get('apart', 0)
    num_scans = max(counted, sum(part['scans'] for part in parts))
    spans = ', '.join(
        f'{part.get("map", f"apart_{number}")} ({part["scans"]} scans from '
        f'{part["first_s"]:.3f} to {part["last_s"]:.3f} s: {part["reason"]})'
        for number, part in enumerate(parts, start=1)
    )
    return (
        f'{num_scans} of {summary["scans"]["received"]} scans have no certain place on the map; '
        f'{tracking["parts_apart"]} maps of their own: {spans}'
    )


def errors_text(errors: Mapping[str, Any]) -> str:
    """Return the errors of poses against the truth in one line."""
    absolute, relative = (
        f'{1e3 * errors[kind]["translation_m"]["rmse"]:.3f} mm, '
        f'{errors[kind]["rotation_deg"]["rmse"]:.3f} deg'
        for kind in ('absolute', 'relative')
    )
    drift = f'{errors["drift_m_per_100m"]:.3f} m, {errors["drift_deg_per_100m"]:.3f} deg'
    return (
        f'errors of {errors["num_poses"]} poses   absolute {absolute} (rmse)   '
        f'from scan to scan {relative}   drift {drift} in 100 m'
    )


def causes_text(counts: Mapping[str, int]) -> str:
    """Return counts of drops by cause in one line: no pose 4, no points 1."""
    return ', '.join(f'{cause.replace("_", " ")} {count}' for cause, count in counts.items())


def rounded(number: int) -> str:
    """Return a count with three digits and k, M or G."""
    for factor, letter in ((10**9, 'G'), (10**6, 'M'), (10**3, 'k')):
        if number >= factor:
            return f'{number / factor:.3g} {letter}'
    return str(number)
