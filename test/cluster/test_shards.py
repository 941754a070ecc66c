# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Shards of a bag, cut anywhere, give the map and the counts of one run."""

from dataclasses import replace
import errno
from itertools import pairwise
import math
from pathlib import Path
import resource
import sys

import numpy as np
import pytest

from surfel_mapper.cluster import tiles
from surfel_mapper.cluster.executors import never, SerialExecutor
from surfel_mapper.cluster.map_reduce import map_bags
from surfel_mapper.cluster.shards import (
    difference,
    LONGEST_S,
    map_shard,
    peak_bytes,
    shard_length_s,
    SHORTEST_S,
)
from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError, FileFormatError, MapError
from surfel_mapper.files.parquet_tiles import dataset_digest
from test import extras
from test.cluster.bags import BAGS, counted, in_one_go, RECORDED_S, shards_of, written

pytestmark = extras.needs('pyarrow')


@pytest.mark.parametrize('name', BAGS)
def test_shards_make_the_map_and_the_counts_of_one_go(tmp_path, name):
    bag, config = written(tmp_path, name)
    expected = in_one_go(bag, config)
    shards = shards_of(bag, config, 0.9)

    mapped = map_bags(shards, SerialExecutor(), tmp_path / 'out')

    assert mapped.map.digest == expected.map.digest()
    assert mapped.map.digest == dataset_digest(tmp_path / 'out' / 'map')
    assert mapped.map.voxels == expected.map.num_voxels > 100
    assert mapped.map.points == expected.map.num_points
    assert mapped.map.surfels == expected.map.num_surfels(config.map.min_points)
    assert counted(mapped.counts()) == counted(expected.summary())


def test_a_bag_is_cut_into_equal_parts_without_gaps(tmp_path):
    bag, config = written(tmp_path, 'plain')
    shards = shards_of(bag, config, 1.0)

    assert len(shards) == 6
    assert shards[0].start_ns is shards[-1].stop_ns is None
    assert all(a.stop_ns == b.start_ns for a, b in pairwise(shards))
    lengths = [(s.stop_ns - s.start_ns) / 1e9 for s in shards[1:-1]]
    assert lengths == pytest.approx([RECORDED_S / 6] * 4)
    assert len(shards_of(bag, config, 100.0)) == 1


@pytest.mark.parametrize(
    'settings',
    [
        {'window.gate_distance_m': 1.0},
        {'align.every_scans': 5, 'window.keep_points': True},
        {'pose.source': 'registration'},
    ],
)
def test_a_bag_whose_scans_depend_on_all_before_is_not_cut(tmp_path, settings):
    bag, _ = written(tmp_path, 'plain')
    assert len(shards_of(bag, Config().replace(settings), 1.0)) == 1


def test_a_lead_in_that_is_too_short_is_noticed_and_mended(tmp_path):
    bag, config = written(tmp_path, 'late poses')
    expected = in_one_go(bag, config)
    short = [replace(shard, lead_s=0.01) for shard in shards_of(bag, config, 1.0)]

    mapped = map_bags(short, SerialExecutor(), tmp_path / 'out')

    assert mapped.repeated > 0
    assert mapped.map.digest == expected.map.digest()


@pytest.mark.parametrize(
    ('recorded_s', 'num_workers', 'shards'),
    [(3.0, 2, 1), (7.0, 2, 2), (40.0, 2, 2), (121.0, 2, 4), (100.0, 3, 3), (3600.0, 1, 60)],
)
def test_every_worker_gets_as_many_shards_as_any_other(recorded_s, num_workers, shards):
    length_s = shard_length_s(recorded_s, num_workers)
    assert math.ceil(recorded_s / length_s - 1e-9) == shards
    assert SHORTEST_S <= length_s <= LONGEST_S


def test_bags_of_nearly_equal_length_are_not_cut(tmp_path):
    bag, config = written(tmp_path, 'plain')
    for shard_s, number in ((RECORDED_S * 0.995, 1), (RECORDED_S / 2 * 0.995, 2), (2.0, 3)):
        assert len(shards_of(bag, config, shard_s)) == number


def test_the_usual_lead_in_is_long_enough(tmp_path):
    bag, config = written(tmp_path, 'plain')
    assert map_bags(shards_of(bag, config, 0.5), SerialExecutor(), tmp_path / 'out').repeated == 0


@pytest.mark.parametrize('every', [1, 3])
def test_a_part_of_a_bag_is_mapped_alike(tmp_path, every):
    bag, config = written(tmp_path, 'plain')
    part = {'start_s': 1.25, 'duration_s': 3.0, 'every': every}
    expected = in_one_go(bag, config, **part)

    shards = shards_of(bag, config, 0.7, **part)
    mapped = map_bags(shards, SerialExecutor(), tmp_path / 'out')

    assert len(shards) == (5 if every == 1 else 1)
    assert mapped.map.digest == expected.map.digest()
    assert mapped.counts()['scans']['received'] == 30 // every


@pytest.mark.parametrize('has_stamps', [True, False])
def test_poses_of_a_file_are_known_in_the_middle_too(tmp_path, has_stamps):
    bag, config = written(tmp_path, 'plain')
    rows = np.zeros((60, 8))
    rows[:, 0], rows[:, 1], rows[:, 3], rows[:, 7] = np.arange(60) / 10, np.arange(60), 1.0, 1.0
    lines = [f'17000000{row[0]:04.1f} ' + ' '.join(map(str, row[1:])) for row in rows]
    if not has_stamps:
        lines = [f'1 0 0 {row[1]} 0 1 0 {row[2]} 0 0 1 {row[3]}' for row in rows]
    poses = tmp_path / 'poses.txt'
    poses.write_text('\n'.join([*lines, '']))
    config = config.replace({'pose.source': 'odometry'})
    part = {'poses': poses, 'poses_format': 'tum' if has_stamps else 'kitti'}
    expected = in_one_go(bag, config, **part)

    shards = shards_of(bag, config, 1.0, **part)
    mapped = map_bags(shards, SerialExecutor(), tmp_path / 'out')

    assert len(shards) == (6 if has_stamps else 1)
    assert mapped.map.digest == expected.map.digest()
    assert mapped.counts()['scans']['mapped'] == 60


class LastFirst(SerialExecutor):
    """Runs the tasks in the opposite order, as may happen among several workers."""

    def run(self, function, items, stopped=never):
        for done, result in super().run(function, items[::-1], stopped):
            yield len(items) - 1 - done, result


def after(number):
    """Return a function that asks to stop after a number of shards."""
    asked = iter(range(number))
    return lambda: next(asked, None) is None


def test_a_stopped_run_gives_the_map_of_the_shards_done(tmp_path):
    bag, config = written(tmp_path, 'plain')
    expected = in_one_go(bag, config, duration_s=RECORDED_S / 6 * 2 - 1e-6)

    shards = shards_of(bag, config, 1.0)
    mapped = map_bags(shards, SerialExecutor(), tmp_path / 'out', stopped=after(2))

    assert mapped.interrupted
    assert len(mapped.results) == 2
    assert mapped.map.digest == expected.map.digest()
    assert counted(mapped.counts()) == counted(expected.summary())


def test_shards_after_a_gap_are_left_out_when_it_is_stopped(tmp_path):
    first, config = written(tmp_path, 'plain')
    second, _ = written(tmp_path, 'faults')
    shards = shards_of(first, config, 3.0) + shards_of(second, config, 3.0)
    expected = in_one_go(second, config)

    mapped = map_bags(shards, LastFirst(), tmp_path / 'out', stopped=after(3))

    assert mapped.interrupted
    assert len(mapped.results) == 2
    assert mapped.map.digest == expected.map.digest()
    with pytest.raises(MapError, match='no scan was mapped'):
        map_bags(shards, LastFirst(), tmp_path / 'out', stopped=after(1))
    assert dataset_digest(tmp_path / 'out' / 'map') == mapped.map.digest


def test_shards_that_do_not_fit_are_left_out_when_it_is_stopped(tmp_path):
    bag, config = written(tmp_path, 'late poses')
    short = [replace(shard, lead_s=0.01) for shard in shards_of(bag, config, 1.0)]
    expected = map_bags(short[:1], SerialExecutor(), tmp_path / 'first')

    mapped = map_bags(short, SerialExecutor(), tmp_path / 'out', stopped=after(3))

    assert mapped.interrupted
    assert len(mapped.results) == 1
    assert mapped.map.digest == expected.map.digest


@pytest.mark.parametrize('shards_asked', [6, 7])
def test_a_bag_in_which_time_is_set_back_is_left_out_when_it_is_stopped(tmp_path, shards_asked):
    """Its first shard was kept if the stop came before it was mapped again."""
    bag, config = written(tmp_path, 'time set back')
    shards = shards_of(bag, config, 1.0)
    assert len(shards) == 6
    with pytest.raises(MapError, match='no scan was mapped'):
        map_bags(shards, SerialExecutor(), tmp_path / 'out', stopped=after(shards_asked))


def test_a_stop_while_a_whole_bag_is_mapped_again_leaves_nothing_missing(tmp_path):
    bag, config = written(tmp_path, 'time set back')
    expected = in_one_go(bag, config)
    told = []

    mapped = map_bags(
        shards_of(bag, config, 1.0),
        SerialExecutor(),
        tmp_path / 'out',
        lambda *done: told.append(done),
        stopped=after(8),  # 6 shards, the end of their round, the whole bag
    )

    assert not mapped.interrupted
    assert mapped.map.digest == expected.map.digest()
    assert counted(mapped.counts()) == counted(expected.summary())
    assert sum(s for kind, s in told if kind == 'map') == pytest.approx(RECORDED_S, abs=0.01)


def test_when_it_is_stopped_at_the_end_nothing_is_missing(tmp_path):
    bag, config = written(tmp_path, 'plain')
    shards = shards_of(bag, config, 3.0)
    assert not map_bags(shards, SerialExecutor(), tmp_path / 'out', stopped=after(2)).interrupted


def test_several_bags_make_the_sum_of_their_maps(tmp_path):
    first, config = written(tmp_path, 'plain')
    second, _ = written(tmp_path, 'faults')
    expected = in_one_go(first, config).map
    expected.merge(in_one_go(second, config).map)

    shards = [*shards_of(first, config, 2.0), *shards_of(second, config, 2.0)]

    assert map_bags(shards, SerialExecutor(), tmp_path / 'out').map.digest == expected.digest()


def test_an_earlier_map_is_replaced_and_nothing_is_left_beside_it(tmp_path):
    bag, config = written(tmp_path, 'plain')
    for shard_s in (1.0, 3.0):
        mapped = map_bags(shards_of(bag, config, shard_s), SerialExecutor(), tmp_path / 'out')
    assert [path.name for path in (tmp_path / 'out').iterdir()] == ['map']
    assert dataset_digest(tmp_path / 'out' / 'map') == mapped.map.digest


def test_a_failure_leaves_an_earlier_map_whole(tmp_path):
    bag, config = written(tmp_path, 'plain')
    before = map_bags(shards_of(bag, config, 3.0), SerialExecutor(), tmp_path / 'out').map.digest
    nowhere = config.replace({'frames.fixed': 'nowhere'})

    with pytest.raises(MapError, match='no scan was mapped'):
        map_bags(shards_of(bag, nowhere, 3.0), SerialExecutor(), tmp_path / 'out')

    assert dataset_digest(tmp_path / 'out' / 'map') == before
    assert [path.name for path in (tmp_path / 'out').iterdir()] == ['map']


def test_a_frozen_map_is_refused(tmp_path):
    bag, config = written(tmp_path, 'plain')
    with pytest.raises(ConfigError, match='several processes begin with empty maps'):
        shards_of(bag, config.replace({'map.load': 'old.npz'}), 1.0)


def test_progress_adds_up_to_the_recording_and_the_tiles(tmp_path):
    bag, config = written(tmp_path, 'plain')
    told = []

    mapped = map_bags(
        shards_of(bag, config, 1.0),
        SerialExecutor(),
        tmp_path / 'out',
        lambda *done: told.append(done),
    )

    assert sum(s for kind, s in told if kind == 'map') == pytest.approx(RECORDED_S, abs=0.01)
    assert sum(n for kind, n in told if kind == 'merge') == mapped.map.tiles
    assert len(mapped.map.sample) == len(mapped.map.drawn) == mapped.map.surfels


def test_pictures_show_tiles_of_many_surfels_by_their_coarser_map(tmp_path, monkeypatch):
    bag, config = written(tmp_path, 'plain')
    monkeypatch.setattr(tiles, 'DRAWN', 400)

    mapped = map_bags(shards_of(bag, config, 1.0), SerialExecutor(), tmp_path / 'out')

    whole = in_one_go(bag, config).map
    coarser = [
        {tuple(row) for row in whole.coarsen(level).surfels(config.map.min_points).position}
        for level in range(7)
    ]
    drawn = {tuple(row) for row in mapped.map.drawn.position}
    assert 0 < len(drawn) <= 400 + mapped.map.tiles < mapped.map.surfels
    assert not drawn & coarser[0]
    assert drawn <= set().union(*coarser)


def test_a_shard_is_the_same_file_each_time_it_is_mapped(tmp_path):
    bag, config = written(tmp_path, 'plain')
    shard = shards_of(bag, config, 2.0)[1]
    contents = []
    for name in ('a', 'b'):
        map_shard(shard, str(tmp_path / name))
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]


def test_counts_are_taken_from_each_other_at_every_depth():
    now = {'a': 5, 'b': {'c': 2, 'd': 1}, 'milliseconds': {'x': {'median': 1.0}}}
    assert difference(now, {'a': 2, 'b': {'c': 2}, 'milliseconds': {}}) == {
        'a': 3,
        'b': {'c': 0, 'd': 1},
        'milliseconds': {'x': {'median': 1.0}},
    }


@pytest.fixture
def datasets(tmp_path):
    """Return a fresh dataset and an earlier one of the name wanted."""
    fresh, wanted = tmp_path / 'fresh', tmp_path / 'map'
    for directory, content in ((fresh, 'new'), (wanted, 'old')):
        (directory / 'tile_i=0').mkdir(parents=True)
        (directory / 'tile_i=0' / 'a').write_text(content)
    return fresh, wanted


def test_a_dataset_that_cannot_take_its_name_leaves_the_earlier_one(datasets, monkeypatch):
    """It kept a hidden name."""
    fresh, wanted = datasets
    rename = Path.rename

    def failing(path, target):
        if path == fresh:
            raise OSError(errno.ENOSPC, 'no space')
        return rename(path, target)

    monkeypatch.setattr(Path, 'rename', failing)
    with pytest.raises(FileFormatError, match='no space'):
        tiles.take_name(fresh, wanted)
    assert (wanted / 'tile_i=0' / 'a').read_text() == 'old'
    monkeypatch.undo()
    tiles.take_name(fresh, wanted)
    assert (wanted / 'tile_i=0' / 'a').read_text() == 'new'
    assert [*wanted.parent.iterdir()] == [wanted]


@pytest.mark.parametrize('renamed', ['map', 'fresh'])
def test_an_interrupt_after_a_rename_leaves_one_whole_dataset(datasets, monkeypatch, renamed):
    """After the first rename there was none of that name."""
    fresh, wanted = datasets
    rename, sources = Path.rename, []

    def interrupted(path, target):
        found = rename(path, target)
        sources.append(path.name)
        if path.name == renamed and sources.count(renamed) == 1:
            raise KeyboardInterrupt
        return found

    monkeypatch.setattr(Path, 'rename', interrupted)
    with pytest.raises(KeyboardInterrupt):
        tiles.take_name(fresh, wanted)
    expected = {'map': 'old', 'fresh': 'new'}[renamed]
    assert (wanted / 'tile_i=0' / 'a').read_text() == expected


def test_a_dataset_that_has_its_name_is_no_failure(datasets, monkeypatch):
    """An error of the last sync was reported, and the earlier dataset kept a hidden name."""
    fresh, wanted = datasets
    sync = tiles.sync_directory

    def failing(directory):
        if directory == wanted.parent:
            raise OSError(errno.EMFILE, 'too many open files')
        sync(directory)

    monkeypatch.setattr(tiles, 'sync_directory', failing)
    tiles.take_name(fresh, wanted)
    assert (wanted / 'tile_i=0' / 'a').read_text() == 'new'
    assert [*wanted.parent.iterdir()] == [wanted]


@pytest.mark.parametrize(('platform', 'unit'), [('darwin', 1), ('freebsd14', 1024)])
def test_the_peak_memory_without_proc_is_in_bytes(monkeypatch, platform, unit):
    """Darwin reports bytes, others KiB; the figure was 1024 times too large there."""
    monkeypatch.setattr(sys, 'platform', platform)
    monkeypatch.setattr(Path, 'exists', lambda path: False)
    monkeypatch.setattr(
        resource, 'getrusage', lambda who: resource.struct_rusage((0.0, 0.0, 7_000_000, *[0] * 13))
    )
    assert peak_bytes() == 7_000_000 * unit
