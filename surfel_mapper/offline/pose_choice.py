# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Choice of the source of poses, when neither the configuration nor the user names one.

This is ``pose.source: auto``, in the order of ``poses.choose_source``. A bag is sampled at its
start: the first of tf, odometry and pose that gives its clouds poses is taken, with the frames
that this needs unless the user has set them. A bag or a folder without poses is registered, scan
to map, and deskewed if its points carry times. ``Request.poses_from`` overrides the choice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TYPE_CHECKING

from surfel_mapper.config import Config
from surfel_mapper.errors import BagError, CloudFormatError
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.offline.pose_sources import DEFAULTS, source_topics, TYPES
from surfel_mapper.offline.survey import depth_topics, mounting, Offer, offers, Survey, survey
from surfel_mapper.poses import AUTO, choose_source, has_chain, PoseCandidate, without_chain
from surfel_mapper.sensors.time_fields import time_fields

if TYPE_CHECKING:
    from surfel_mapper.bags.reader import BagReader
    from surfel_mapper.offline.request import Request
    from surfel_mapper.scan import Scan

SAMPLE_NS = 3_000_000_000
"""Length of the sample of a bag, quadrupled until it contains a cloud."""

DEFAULT = Config()

USUAL = [types[0] for types in TYPES.values()]
"""Types of poses that a choice need not name."""

NOT_READ = ('nav_msgs/msg/Path', 'geometry_msgs/msg/TransformStamped')
"""Types that have poses too."""

SETTING = {'file': 'pose'}
"""The pose.source of a choice that has another name."""


@dataclass(frozen=True, slots=True)
class PoseChoice:
    """
    Configuration with the source of the poses.

    Attributes
    ----------
    config : Config
        The configuration given, with the ``pose.source`` chosen and the settings that it needs.
    reason : str
        Why it was chosen; empty if it was configured or asked for.
    topic : str
        The topic that was chosen; empty if the configuration decides.

    """

    config: Config
    reason: str = ''
    topic: str = ''


def choose_for_bag(
    reader: BagReader,
    topics: Sequence[str],
    request: Request,
    config: Config,
    sample: Callable[[], Survey],
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
        Its ``pose.source`` counts unless it is auto, and its ``frames``.
    sample : callable
        Returns a survey of the first clouds of the bag; see ``sampled``.

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
    asked = config.replace({'pose.source': wanted or AUTO})
    has_poses = any(reader.topics.of_type(*types) for types in TYPES.values())
    is_framed = config.frames != DEFAULT.frames or request.mounts or request.pose_topic
    if has_poses and not is_framed and (not is_depth or depth_topics(reader)):
        return choose_by_sample(reader, topics, wanted, asked, sample())
    if wanted is not None:
        return PoseChoice(asked)
    if has_poses or request.pose_topic:
        return choose_by_frames(reader, topics, request, config, sample)
    return registered(reader, topics, config, 'the recording has no poses')


def choose_by_sample(
    reader: BagReader, topics: Sequence[str], wanted: str | None, config: Config, sample: Survey
) -> PoseChoice:
    """Return the source that gives the clouds of a sample their poses, or registration."""
    sources = list(TYPES) if wanted is None else [wanted]
    made = [offer for offer in offers(sample) if offer.clouds in topics]
    usable_offers = [offer for offer in made if is_usable(offer, sample)]
    best = {source: tried for source in sources if (tried := best_offer(made, source, sample))}
    usable = [offer for offer in best.values() if is_usable(offer, sample)]
    has_half = any(2 * offer.covered >= offer.total for offer in usable)
    candidates = [candidate(source, best.get(source), sample, has_half) for source in sources]
    choice = choose_source(candidates)
    if choice.topic:
        settings = best[choice.source].settings
        rivals = {o.poses for o in usable_offers if source_of(o) == choice.source}
        topic = choice.topic if len(rivals) == 1 else ''  # else the user has to name one
        is_plain = wanted is not None and not changes(settings)
        reason = '' if is_plain else choice.reason
        return PoseChoice(config.replace(settings), reason, topic)
    if wanted is not None:
        return PoseChoice(config)
    return registered(reader, topics, config, choice.reason)


def best_offer(made: Sequence[Offer], source: str, sample: Survey) -> Offer | None:
    """Return the best offer of a source, those that can be used first; None if there is none."""
    of_source = [offer for offer in made if source_of(offer) == source]
    return min(of_source, key=lambda o: (not is_usable(o, sample), -o.covered), default=None)


def candidate(source: str, offer: Offer | None, sample: Survey, needs_half: bool) -> PoseCandidate:
    """Return the best offer of a source as a candidate; some need poses for half of the clouds."""
    if offer is None:
        return PoseCandidate(source, '', 'no topic' if sample.stamps else 'no cloud can be read')
    missing, name = '', offer.poses
    surveyed = sample.topics.get(name)
    if surveyed and surveyed.topic.type not in USUAL:
        name += f' ({surveyed.topic.type.rpartition("/")[2]})'
    if not is_usable(offer, sample):
        missing = f'{name}: {offer.missing or "none of them moves"}'
    elif needs_half and 2 * offer.covered < offer.total:
        missing = f'{name} covers {offer.covered} of {offer.total} clouds'
    texts = [f'{key}: {value}' for key, value in changes(offer.settings).items()]
    if name != offer.poses:
        texts.insert(0, name)
    return PoseCandidate(source, offer.poses, missing, ', '.join(texts))


def changes(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of an offer that are not the defaults, without ``pose.source``."""
    default = DEFAULT.to_mapping()
    return {
        name: value
        for name, value in settings.items()
        if value != default[name] and name != 'pose.source'
    }


def choose_by_frames(
    reader: BagReader,
    topics: Sequence[str],
    request: Request,
    config: Config,
    sample: Callable[[], Survey],
) -> PoseChoice:
    """Return the first source that is there, as the node does, with the frames of the user."""
    candidates = []
    for source, types in TYPES.items():
        names = source_topics(reader.topics, source)
        if request.pose_topic is not None:
            names = [name for name in reader.topics.of_type(*types) if name == request.pose_topic]
            if not names:
                continue
        missing = '' if names else 'no topic'
        if names and source == 'tf' and config.input.kind == 'cloud':
            missing = missing_transforms(sample(), topics, request, config)
        topic = DEFAULTS[source] if DEFAULTS[source] in names else (names or [''])[0]
        candidates.append(PoseCandidate(source, topic, missing))
    choice = choose_source(candidates)
    if choice.topic:
        settings = {'pose.source': choice.source}
        return PoseChoice(config.replace(settings), choice.reason, choice.topic)
    if request.pose_topic is not None:
        return PoseChoice(config)  # pose_topics refuses its name
    return registered(reader, topics, config, choice.reason)


def missing_transforms(
    sample: Survey, topics: Sequence[str], request: Request, config: Config
) -> str:
    """Return which frames of clouds have no transforms to the fixed frame; empty if all have."""
    frames = config.frames
    parents = {
        pose.child: pose.parent
        for topic, poses in sample.poses.items()
        if sample.topics[topic].topic.type in TYPES['tf'] and request.pose_topic in (None, topic)
        for pose in poses
    }
    names = [*topics, *filter(None, [request.pose_topic])]
    parents |= {pose.child: pose.parent for pose in sample.static_for(*names)}
    parents |= dict.fromkeys(request.mounts, frames.base)
    of_clouds = {
        topic if topic in request.mounts else frame
        for topic, frame in sample.stamps
        if topic in topics
    }
    parents |= {frame: frames.base for frame in of_clouds if frames.mount_of(frame)}
    alone = [frame for frame in of_clouds if not has_chain(parents, frames.fixed, frame)]
    return without_chain(frames.fixed, alone) if alone else ''


def registered(
    reader: BagReader, topics: Sequence[str], config: Config, reason: str
) -> PoseChoice:
    """Return registration of the clouds or depth images of a bag, for a reason."""
    names = [f'{topic.name} ({topic.type})' for topic in reader.topics if topic.type in NOT_READ]
    reason += f'; not read: {", ".join(names)}' if names else ''
    scans = [] if config.input.kind == 'depth' else first_scans(reader, topics)
    return PoseChoice(with_registration(config, scans), reason)


def source_of(offer: Offer) -> str:
    """Return the pose.source of an offer."""
    return str(offer.settings['pose.source'])


def is_usable(offer: Offer, surveyed: Survey) -> bool:
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
    frames = [frame for clouds, frame in surveyed.stamps if clouds == offer.clouds]
    static = surveyed.static_for(offer.clouds, offer.poses)
    return not any(fixed == frame or mounting(static, fixed, frame) for frame in frames)


def sampled(reader: BagReader, offsets_ns: Mapping[str, int]) -> Survey:
    """Return a survey of the first clouds of a bag, with offsets added to their stamps."""
    length_ns = SAMPLE_NS
    while True:
        first_clouds = survey(reader, stop_ns=reader.start_ns + length_ns, offsets_ns=offsets_ns)
        if first_clouds.stamps or reader.start_ns + length_ns > reader.end_ns:
            return first_clouds
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
        Its ``pose.source`` counts unless it is auto.
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
        return None if request.poses_from == AUTO else request.poses_from
    return config.pose.source if config.pose.source != AUTO else None


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
    if config.deskew == DEFAULT.deskew and scans and not any(map(times_error, scans)):
        settings['deskew.enabled'] = True
    return config.replace(settings)


def is_default(config: Config) -> bool:
    """Return whether a configuration leaves source and frames of the poses open."""
    return config.pose.source == AUTO and config.frames == DEFAULT.frames


def times_error(scan: Scan) -> str:
    """Return why the points of a scan have no times to deskew with; empty if they have."""
    from surfel_mapper.sensors.deskew import point_times  # it loads the compiler

    try:
        times = point_times(scan)
    except CloudFormatError as error:
        return str(error)
    return '' if times.last_ns > times.first_ns else 'all points have one time'


def why_not_deskewed(config: Config, scans: Sequence[Scan]) -> str:
    """Return why scans whose points have times are not deskewed; empty if they are or rest."""
    if config.deskew.enabled or config.pose.source == 'identity':
        return ''
    for scan in scans:
        if names := time_fields(scan.columns):
            reason = f'points have times ({", ".join(names)}), which deskew.enabled: true uses'
            return times_error(scan) or reason if config.deskew == DEFAULT.deskew else reason
    return ''


def pose_summary(
    config: Config, path: object, reason: str, deskew_reason: str = ''
) -> dict[str, Any]:
    """Return the source of the poses for the summary; why, if it was not configured."""
    return {
        'poses_from': 'file' if path is not None else config.pose.source,
        'poses_reason': reason,
        'deskewed': config.deskew.enabled,
        'deskew_reason': deskew_reason,
    }
