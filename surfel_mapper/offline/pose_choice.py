# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Choice of the source of poses, when neither the configuration nor the user names one.

A bag is sampled at its start: the first of tf, odometry and pose that gives its clouds poses is
taken, with the frames that this needs. A bag or a folder without poses is registered, scan to
map, and deskewed if its points carry times. ``Request.poses_from`` overrides the choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TYPE_CHECKING

from surfel_mapper.config import Config
from surfel_mapper.errors import BagError, CloudFormatError
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.offline.pose_sources import TYPES
from surfel_mapper.offline.survey import mounting, Offer, offers, Survey, survey

if TYPE_CHECKING:
    from surfel_mapper.bags.reader import BagReader
    from surfel_mapper.offline.request import Request
    from surfel_mapper.scan import Scan

SAMPLE_NS = 3_000_000_000
"""Length of the sample of a bag, quadrupled until it contains a cloud."""

DEFAULT = Config()

KINDS = list(TYPES)

SETTING = {'file': 'pose'}
"""The pose.source of a choice that has another name."""


@dataclass(frozen=True, slots=True)
class PoseChoice:
    """
    Configuration with the source of the poses.

    Attributes
    ----------
    config : Config
        The configuration given, with ``pose.source`` and the settings that this source needs.
    reason : str
        Why this source was chosen; empty if it was configured or asked for.

    """

    config: Config
    reason: str = ''


def choose_for_bag(
    reader: BagReader, topics: Sequence[str], request: Request, config: Config
) -> PoseChoice:
    """
    Choose the source of the poses of a bag.

    Parameters
    ----------
    reader : BagReader
        The bag.
    topics : sequence of str
        The topics of clouds that are mapped.
    request : Request
        Its ``poses_from`` and ``poses`` come first.
    config : Config
        Its ``pose.source`` counts if it is not the default, and its ``frames``.

    Raises
    ------
    BagError
        If ``poses_from`` and ``poses`` contradict each other.

    """
    wanted = wanted_source(request, config)
    is_depth = config.input.kind == 'depth'  # all pixels have one time: nothing to deskew
    if wanted == 'registration' and request.poses_from is not None and not is_depth:
        return PoseChoice(with_registration(config, first_scans(reader, topics)))
    if wanted in ('file', 'identity', 'registration'):
        return PoseChoice(config.replace({'pose.source': SETTING.get(wanted, wanted)}))
    asked = config if wanted is None else config.replace({'pose.source': wanted})
    if is_depth:
        return PoseChoice(asked)
    has_poses = any(reader.topics.of_type(type_) for type_ in TYPES.values())
    is_framed = config.frames != DEFAULT.frames or request.mounts or request.pose_topic
    if has_poses and is_framed:
        return PoseChoice(asked)
    if has_poses:
        return choose_by_sample(reader, topics, wanted, asked)
    if wanted is not None:
        return PoseChoice(asked)
    scans = first_scans(reader, topics)
    return PoseChoice(with_registration(config, scans), 'the recording has no poses')


def choose_by_sample(
    reader: BagReader, topics: Sequence[str], wanted: str | None, config: Config
) -> PoseChoice:
    """Return the source that gives the clouds of a sample their poses, or registration."""
    found = sampled(reader)
    made = [
        offer
        for offer in offers(found)
        if offer.clouds in topics and wanted in (None, offer.settings['pose.source'])
    ]
    usable = [offer for offer in made if is_usable(offer, found)]
    if usable:
        best = min(usable, key=lambda o: (2 * o.covered < o.total, KINDS.index(source_of(o))))
        default = DEFAULT.to_mapping()
        changed = {name: value for name, value in best.settings.items() if value != default[name]}
        if not changed or (wanted is not None and list(changed) == ['pose.source']):
            return PoseChoice(config.replace({'pose.source': source_of(best)}))
        text = ', '.join(f'{name}: {value}' for name, value in changed.items())
        return PoseChoice(config.replace(best.settings), f'{best.poses} has them ({text})')
    if wanted is not None or not found.stamps:
        return PoseChoice(config)
    why = (
        f'{made[0].poses}: {made[0].missing}' if made and made[0].missing else 'none of them moves'
    )
    scans = first_scans(reader, topics)
    reason = f'no topic gives the poses of the clouds ({why})'
    return PoseChoice(with_registration(config, scans), reason)


def source_of(offer: Offer) -> str:
    """Return the pose.source of an offer."""
    return str(offer.settings['pose.source'])


def is_usable(offer: Offer, found: Survey) -> bool:
    """
    Return whether a source gives poses of a moving sensor.

    A tree of static transforms alone is not evidence that the robot stood still, unless it
    contains odom or map.
    """
    if not offer.covered or offer.settings.get('frames.base_to_sensor') == []:
        return False
    fixed = offer.settings['frames.fixed']
    if source_of(offer) != 'tf' or fixed in ('odom', 'map'):
        return True
    frames = [frame for clouds, frame in found.stamps if clouds == offer.clouds]
    return not any(fixed == frame or mounting(found.static, fixed, frame) for frame in frames)


def sampled(reader: BagReader) -> Survey:
    """Return a survey of the first clouds of a bag."""
    length_ns = SAMPLE_NS
    while True:
        found = survey(reader, stop_ns=reader.start_ns + length_ns)
        if found.stamps or reader.start_ns + length_ns > reader.end_ns:
            return found
        length_ns *= 4


def choose_for_folder(
    request: Request, config: Config, has_poses: bool, first: Scan | None, missing: str = ''
) -> PoseChoice:
    """
    Choose the source of the poses of a folder of scans.

    Parameters
    ----------
    request : Request
        Its ``poses_from`` and ``poses`` come first.
    config : Config
        Its ``pose.source`` counts if it is not the default.
    has_poses : bool
        Whether the folder has poses of its own.
    first : Scan, optional
        The first scan that can be read.
    missing : str
        The file for lack of which the poses of the folder are not used, for the reason.

    Raises
    ------
    BagError
        If a source is asked for that only bags have.

    """
    wanted = wanted_source(request, config)
    if wanted == 'file' or (has_poses and wanted is None):
        return PoseChoice(config.replace({'pose.source': 'pose'}))
    if wanted == 'identity' or (wanted == 'registration' and request.poses_from is None):
        return PoseChoice(config.replace({'pose.source': wanted}))
    if wanted not in (None, 'registration'):
        raise BagError(
            f'{request.path}: a folder of scans has no messages with poses (pose.source '
            f'{wanted}); name a file of poses with --poses, or use --poses-from registration or '
            'identity'
        )
    reason = '' if wanted else missing or 'the scans come without poses'
    return PoseChoice(with_registration(config, [first] if first else []), reason)


def wanted_source(request: Request, config: Config) -> str | None:
    """Return the source that was asked for or configured; None if it is to be chosen."""
    if request.poses_from == 'file' and request.poses is None:
        raise BagError(f'{request.path}: --poses-from file, expected the file with --poses')
    if request.poses is not None and request.poses_from not in (None, 'file'):
        raise BagError(
            f'{request.path}: --poses-from {request.poses_from} and --poses {request.poses}, '
            'expected one of them'
        )
    if request.poses is not None:
        return 'file'
    if request.poses_from is not None:
        return request.poses_from
    return config.pose.source if config.pose.source != DEFAULT.pose.source else None


def first_scans(reader: BagReader, topics: Sequence[str]) -> list[Scan]:
    """Return the first scan of each topic that can be decoded."""
    scans = []
    for topic in topics:
        for message in reader.messages([topic]):
            try:
                scans.append(to_scan(reader.decode(message), topic))
            except (CloudFormatError, BagError):
                continue
            break
    return scans


def with_registration(config: Config, scans: Sequence[Scan]) -> Config:
    """Return a configuration with registration, and deskewing if all scans carry times."""
    settings: dict[str, object] = {'pose.source': 'registration'}
    if config.deskew == DEFAULT.deskew and scans and all(map(has_times, scans)):
        settings['deskew.enabled'] = True
    return config.replace(settings)


def is_default(config: Config) -> bool:
    """Return whether a configuration leaves source and frames of the poses open."""
    return config.pose.source == DEFAULT.pose.source and config.frames == DEFAULT.frames


def has_times(scan: Scan) -> bool:
    """Return whether the points of a scan carry times that differ."""
    from surfel_mapper.sensors.deskew import point_times  # it loads the compiler

    try:
        times = point_times(scan)
    except CloudFormatError:
        return False
    return times.last_ns > times.first_ns


def pose_summary(config: Config, path: object, reason: str) -> dict[str, Any]:
    """Return the source of the poses for the summary; why, if it was not configured."""
    return {
        'poses_from': 'file' if path is not None else config.pose.source,
        'poses_reason': reason,
        'deskewed': config.deskew.enabled,
    }
