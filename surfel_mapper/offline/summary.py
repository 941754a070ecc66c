# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Text for people from the summary of a replay: a few lines for the terminal, parts of titles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from surfel_mapper.counters import decimals
from surfel_mapper.errors import counted

LEAST_MAPPED = 0.95
"""Share of the scans that came which a map needs; with fewer, something is wrong."""

STATES = {
    'lost': 'had no certain place on the map',
    'unconfirmed': 'waited to be confirmed by the next scans',
    'ambiguous': 'fit two places about equally well',
    'degenerate': 'did not determine all directions of motion',
}
"""Statements about the scans in a state of tracking."""

DOUBTFUL = {
    'surrounded': (5, 'most surfaces seem to move with the sensor'),
    'ambiguous': (5, 'two places fit about equally well'),
    'degenerate': (3, 'surfaces do not determine every direction of motion'),
    'jumped': (1, 'a place far from the expected one was taken without being certain'),
    'rejoined': (1, 'only their separate map as a whole had a certain place'),
}
"""States that put poses in doubt: the least number of scans, as right maps of halls and streets
have up to one ambiguous scan, and the statement."""


def as_text(summary: Mapping[str, Any], written: Sequence[str]) -> str:
    """Return the summary in a few lines for people."""
    scans = summary['scans']
    num_dropped = sum(scans['dropped'].values())
    out = f' ({num_dropped} dropped: {causes_text(scans["dropped"])})' if num_dropped else ''
    gated = f' ({scans["gated"]} left out by the motion gate)'
    localised = f' ({scans["localised"]} aligned to a frozen map)' if 'localised' in scans else ''
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
    deskewed = ', deskewed' if summary.get('deskewed') else ''
    poses = (
        f'poses from {summary["poses_from"]}{deskewed}: {summary["poses_reason"]}\n'
        if summary.get('poses_reason')
        else ''
    )
    if summary.get('deskew_reason'):
        poses += f'not deskewed: {summary["deskew_reason"]}\n'
    settings = summary.get('settings', {})
    is_depth = settings.get('input.kind') == 'depth'  # with a voxel size of its own
    voxels = f' in voxels of {settings["map.voxel_size_m"]:g} m' if is_depth else ''
    return (
        f'{poses}'
        f'scans {scans["received"]}{out}'
        f'{gated if scans["gated"] else ""}{localised}   points {rounded(summary["points"])}   '
        f'surfels {summary["surfels"]}{voxels}\n'
        f'{stages_text(summary)}\n'
        f'{filters}{tracking_text(summary)}{aligned}{errors}{f"{apart}{chr(10)}" if apart else ""}'
        f'digest {summary["digest"]}\n'
        f'{"   ".join(written)}'
    )


def stages_text(summary: Mapping[str, Any]) -> str:
    """
    Return the times of the stages, whose sum is the total, and the speed.

    Each is that of the whole replay by scan received, in the thread that maps; ``other`` is the
    rest of the total, mostly the time to pass scans to a second thread. ``mapping`` is the median
    time of a scan once it is decoded, and the 99th percentile, without the first scan. Workers map
    at the same time, so theirs are the stages of the whole, in seconds.
    """
    from surfel_mapper.counters import STAGES  # loads numpy, which --help does not need

    of_workers = summary.get('wall_s')
    stages = of_workers.items() if of_workers else in_order(summary['stage_s'], STAGES)
    seconds = {stage: s for stage, s in stages if stage != 'total'}
    seconds['other'] = summary['replay_s'] - sum(seconds.values())
    seconds['total'] = summary['replay_s']
    speed = ''
    if summary['recorded_s']:  # not of a single scan
        speed = f'   {summary["recorded_s"] / summary["replay_s"]:.1f} times real time'
    if of_workers:
        return '   '.join(f'{stage} {s:.1f} s' for stage, s in seconds.items()) + speed
    share = 1e3 / max(summary['scans']['received'], 1)
    means = '   '.join(f'{stage} {share * s:.1f} ms' for stage, s in seconds.items()) + ' a scan'
    mapping = summary['milliseconds'].get('total')
    if mapping:
        means += f'   mapping {mapping["median"]:.1f} ms, p99 {mapping["p99"]:.1f}'
    return means + speed


def in_order(values: Mapping[str, Any], names: Sequence[str]) -> list[tuple[str, Any]]:
    """Return items in the order of names; those of other names, of layers, at the end."""
    first = [name for name in names if name in values]
    return [(name, values[name]) for name in [*first, *(n for n in values if n not in first)]]


def uncertain_text(summary: Mapping[str, Any]) -> str:
    """Return why a map is in doubt, or lacks more scans than usual; empty if neither is so."""
    texts = [apart_text(summary), tracking_doubt(summary), missing_text(summary)]
    texts += [summary.get(name, '') for name in ('mount_changes', 'pose_doubt')]
    if not summary['surfels'] and not texts[2]:
        texts.append(
            'the map has no surfels: no voxel has map.min_points points. Are the points not in '
            'metres, or the voxels too small?'
        )
    if num_errors := summary.get('messages_ignored', {}).get('internal_error'):
        texts.append(f'{counted(num_errors, "internal error")}: report them with the log of -vv')
    clocks = [offset['text'] for offset in summary.get('clock_offsets', [])]
    return '\n'.join(filter(None, [*texts, *clocks]))


def missing_text(summary: Mapping[str, Any]) -> str:
    """Return the number of scans in the map, and the causes, if more than 5 % are not in it."""
    scans, resets = summary['scans'], summary.get('resets', 0)
    num_mapped = scans['mapped']
    if resets and summary['window_scans']:  # the map has only the scans since the last one
        num_mapped = summary['window_scans'] + sum(scans['evicted'].values())
    num_used = num_mapped + scans['gated'] + scans.get('localised', 0)
    if num_used >= LEAST_MAPPED * scans['received']:
        return ''
    causes = causes_text(scans['dropped'])
    cleared = scans['mapped'] - num_mapped
    if cleared > 0:
        causes = ', '.join(filter(None, [causes, f'mapped before time was set back {cleared}']))
    return f'only {num_used} of {scans["received"]} scans are in the map: {causes}'


def tracking_text(summary: Mapping[str, Any]) -> str:
    """Return a line for each state of tracking with scans, which warnings named one by one."""
    states = summary.get('registration', {}).get('tracking', {})
    received = summary['scans']['received']
    return ''.join(
        f'registration: {counts["scans"]} of {received} scans {statement} '
        f'({counts["first_s"]:.3f} to {counts["last_s"]:.3f} s)\n'
        for state, statement in STATES.items()
        if (counts := states.get(state)) and 'first_s' in counts
    )


def tracking_doubt(summary: Mapping[str, Any]) -> str:
    """Return a sentence for each state of tracking that puts the poses of scans in doubt."""
    states = summary.get('registration', {}).get('tracking', {})
    received = summary['scans']['received']
    return '\n'.join(
        f'in {spent["scans"]} of {received} scans ({spent["first_s"]:.3f} to '
        f'{spent["last_s"]:.3f} s) {statement}: their poses may be wrong'
        for state, (least, statement) in DOUBTFUL.items()
        if (spent := states.get(state)) and spent['scans'] >= least
    )


def apart_text(summary: Mapping[str, Any]) -> str:
    """Return the parts that stayed apart, and why; empty if there are none."""
    tracking = summary.get('registration', {})
    maps = tracking.get('apart', [])
    if not maps:
        return ''
    num_dropped = summary['scans']['dropped'].get('apart', 0)
    num_scans = max(num_dropped, sum(entry['scans'] for entry in maps))
    spans = ', '.join(
        f'apart_{number} ({counted(entry["scans"], "scan")} from '
        f'{entry["first_s"]:.3f} to {entry["last_s"]:.3f} s: {entry["reason"]})'
        for number, entry in enumerate(maps, start=1)
    )
    return (
        f'{num_scans} of {summary["scans"]["received"]} scans have no certain place on the map; '
        f'{counted(tracking["parts_apart"], "separate map")}: {spans}'
    )


def errors_text(errors: Mapping[str, Any]) -> str:
    """Return the errors of poses against the truth in one line."""
    absolute, relative = (
        f'{decimals(errors[kind]["translation_m"]["rmse"], 1e3)} mm, '
        f'{decimals(errors[kind]["rotation_deg"]["rmse"])} deg'
        for kind in ('absolute', 'relative')
    )
    drift_m, drift_deg = errors['drift_m_per_100m'], errors['drift_deg_per_100m']
    return (
        f'errors of {counted(errors["num_poses"], "pose")}   absolute {absolute} (rmse)   '
        f'from scan to scan {relative}   '
        f'drift {decimals(drift_m)} m, {decimals(drift_deg)} deg in 100 m'
    )


def causes_text(counts: Mapping[str, int]) -> str:
    """Return counts of drops by cause in one line: no pose 4, no points 1."""
    return ', '.join(f'{cause.replace("_", " ")} {n}' for cause, n in counts.items() if n)


def rounded(number: int) -> str:
    """Return a count with three digits and k, M or G."""
    for factor, letter in ((10**9, 'G'), (10**6, 'M'), (10**3, 'k')):
        if number >= factor:
            return f'{number / factor:.3g} {letter}'
    return str(number)
