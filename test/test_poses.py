# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The buffer of transforms: exact results, interpolation, refusals.

The twin below has no tracks and no common ancestors: it multiplies 4 by 4 matrices from the root
to each of two frames and solves for the transform between them, with scipy's slerp.

(Longer than other files: most tests need the twin.)
"""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from surfel_mapper.errors import PoseError, PoseNotYetError, PosesLateError
from surfel_mapper.geometry import compose, pose_matrix
from surfel_mapper.poses import buffer as buffer_module
from surfel_mapper.poses import TransformBuffer

S = 1_000_000_000
EPOCH = 1_700_000_000 * S


def some_pose(seed):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    return pose_matrix(rng.uniform(-10, 10, 3), q / np.linalg.norm(q))


def moved(x):
    return pose_matrix([x, 0, 0], [0, 0, 0, 1])


def drive(**durations):
    """Return a buffer of odom -> base at 0, 1, 2, 3 s, x = 10 times that, and base -> lidar."""
    buffer = TransformBuffer(**durations)
    for second in range(4):
        buffer.add('odom', 'base', EPOCH + second * S, moved(10.0 * second))
    buffer.add_static('base', 'lidar', some_pose(1))
    return buffer


def not_yet(buffer, *asked):
    with pytest.raises(PoseNotYetError) as caught:
        buffer.lookup(*asked)
    return str(caught.value)


def never(buffer, *asked):
    with pytest.raises(PoseError) as caught:
        buffer.lookup(*asked)
    assert not isinstance(caught.value, PoseNotYetError)
    return str(caught.value)


# What is found


def test_a_lookup_at_a_stored_stamp_returns_the_stored_bits():
    buffer = TransformBuffer()
    poses = [some_pose(seed) for seed in range(50)]
    for k, pose in enumerate(poses):
        buffer.add('odom', 'base', EPOCH + 37 * k, pose)

    for k, pose in enumerate(poses):
        assert buffer.lookup('odom', 'base', EPOCH + 37 * k).tobytes() == pose.tobytes()


@given(st.data())
def test_any_tree_gives_what_a_slow_twin_gives(data):
    num_frames = data.draw(st.integers(2, 7))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    stamps = np.sort(rng.choice(1000, size=6, replace=False))
    asked_at = int(rng.integers(stamps[0], stamps[-1] + 1))
    buffer = TransformBuffer()
    T_root_frame = [np.eye(4)]
    for child in range(1, num_frames):
        parent = int(rng.integers(child))
        turns, places = Rotation.from_quat(rng.normal(size=(6, 4))), rng.uniform(-10, 10, (6, 3))
        poses = [pose_matrix(p, q) for p, q in zip(places, turns.as_quat(), strict=True)]
        T_parent_child = np.eye(4)
        if rng.random() < 0.3:
            buffer.add_static(str(parent), str(child), poses[0])
            T_parent_child = poses[0]
        else:
            for k in rng.permutation(6):
                buffer.add(str(parent), str(child), int(stamps[k]), poses[k])
            T_parent_child[:3, :3] = Slerp(stamps, turns)(asked_at).as_matrix()
            for axis in range(3):
                T_parent_child[axis, 3] = np.interp(asked_at, stamps, places[:, axis])
        T_root_frame.append(T_root_frame[parent] @ T_parent_child)
    target, source = (int(v) for v in rng.integers(num_frames, size=2))

    found = buffer.lookup(str(target), str(source), asked_at)

    expected = np.linalg.solve(T_root_frame[target], T_root_frame[source])
    # up to 12 products of numbers below 100; a slerp of almost half a turn amplifies rounding
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


# Order of insertion and content


@given(st.permutations(range(8)))
def test_the_order_of_arrival_within_the_tolerated_lateness_makes_no_difference(order):
    in_order, mixed = TransformBuffer(), TransformBuffer()
    for buffer, ranks in ((in_order, range(8)), (mixed, order)):
        for k in ranks:
            buffer.add('odom', 'base', EPOCH + k * 10**8, some_pose(k))

    for stamp in range(EPOCH, EPOCH + 7 * 10**8 + 1, 35 * 10**6):
        expected = in_order.lookup('odom', 'base', stamp)
        assert mixed.lookup('odom', 'base', stamp).tobytes() == expected.tobytes()
    assert mixed.newest_ns == EPOCH + 7 * 10**8


def test_the_same_stamp_again_replaces():
    buffer = drive()
    buffer.add('odom', 'base', EPOCH + 2 * S, moved(-1.0))

    assert buffer.lookup('odom', 'base', EPOCH + 2 * S)[0, 3] == -1.0
    assert buffer.lookup('odom', 'base', EPOCH + 3 * S)[0, 3] == 30.0


def test_a_stamp_back_by_no_more_than_the_limit_is_inserted():
    buffer = drive(reset_after_s=2.5)
    buffer.add('odom', 'base', EPOCH + 3 * S - 2_500_000_000, moved(77.0))

    assert buffer.lookup('odom', 'base', EPOCH + S // 2)[0, 3] == 77.0
    assert buffer.lookup('odom', 'base', EPOCH + 3 * S)[0, 3] == 30.0


def test_a_stamp_back_by_more_than_the_limit_forgets_that_edge_only():
    buffer = drive(reset_after_s=2.5)
    buffer.add('map', 'odom', EPOCH + 9 * S, moved(1.0))
    buffer.add('odom', 'base', EPOCH + 3 * S - 2_500_000_001, moved(77.0))

    assert buffer.lookup('odom', 'base', EPOCH + 499_999_999)[0, 3] == 77.0
    not_yet(buffer, 'odom', 'base', EPOCH + 3 * S)
    never(buffer, 'odom', 'base', EPOCH)
    assert buffer.lookup('map', 'odom', EPOCH + 9 * S)[0, 3] == 1.0


def test_the_history_reaches_back_from_the_newest_by_its_length():
    buffer = drive(history_s=2.0)

    assert buffer.lookup('odom', 'base', EPOCH + S)[0, 3] == 10.0
    never(buffer, 'odom', 'base', EPOCH + S - 1)


def test_the_history_stays_bounded():
    buffer = TransformBuffer(history_s=0.5)
    for k in range(2000):
        buffer.add('odom', 'base', k * 10**7, moved(0.0))

    assert len(buffer._edges['base'].stamps) == len(buffer._edges['base'].transforms) == 51


def test_without_history_only_the_newest_is_known():
    buffer = drive(history_s=0.0)

    assert buffer.lookup('odom', 'base', EPOCH + 3 * S)[0, 3] == 30.0
    never(buffer, 'odom', 'base', EPOCH + 3 * S - 1)


def test_clearing_forgets_dynamic_edges_and_keeps_static_ones():
    buffer = drive()
    buffer.clear()

    assert buffer.newest_ns is None
    np.testing.assert_array_equal(buffer.lookup('base', 'lidar', 0), some_pose(1))
    not_yet(buffer, 'odom', 'lidar', EPOCH)
    buffer.add('map', 'base', 5, moved(1.0))
    assert buffer.lookup('map', 'base', 5)[0, 3] == 1.0


# What is not there


def test_newer_than_the_newest_is_not_there_yet_and_says_what_is():
    message = not_yet(drive(), 'odom', 'lidar', EPOCH + 3 * S + 1)

    assert message == (
        'odom <- lidar at 1700000003.000000001 s: newer than all of odom -> base '
        '(held from 1700000000.000000000 to 1700000003.000000000 s)'
    )


def test_older_than_the_oldest_is_never_there_and_says_what_is():
    message = never(drive(), 'odom', 'lidar', EPOCH - 1)

    assert message == (
        'odom <- lidar at 1699999999.999999999 s: older than all of odom -> base '
        '(held from 1700000000.000000000 to 1700000003.000000000 s)'
    )


def test_a_frame_never_seen_may_still_come():
    message = not_yet(drive(), 'map', 'radar', EPOCH)

    assert 'no transform of map and radar yet; frames seen: base, lidar, odom' in message
    assert 'frames seen: none' in not_yet(TransformBuffer(), 'odom', 'base', 0)


def test_the_edge_between_two_known_trees_may_still_come():
    buffer = TransformBuffer()
    buffer.add_static('map', 'odom', some_pose(1))
    buffer.add_static('base', 'lidar', some_pose(2))
    assert 'no transforms lead' in not_yet(buffer, 'map', 'lidar', EPOCH)

    buffer.add('odom', 'base', EPOCH, some_pose(3))
    buffer.lookup('map', 'lidar', EPOCH)


def test_a_lookup_climbs_a_limited_number_of_edges_whatever_is_above(monkeypatch):
    monkeypatch.setattr(buffer_module, 'MAX_DEPTH', 4)
    buffer = TransformBuffer()
    for parent, child in [('c', 'd'), ('b', 'c'), ('d', 'e'), ('a', 'b')]:
        buffer.add(parent, child, EPOCH, moved(1.0))
    before = buffer.num_transforms
    with pytest.raises(PoseError, match="over 4 transforms above 'new'"):
        buffer.add('e', 'new', EPOCH, moved(1.0))
    assert buffer.num_transforms == before
    for k in range(9):
        buffer.add(f'top_{k}', 'a' if k == 0 else f'top_{k - 1}', EPOCH, moved(1.0))

    assert buffer.lookup('a', 'e', EPOCH)[0, 3] == 4.0
    not_yet(buffer, 'top_0', 'e', EPOCH)


def test_the_number_of_transforms_is_limited_and_the_longest_edge_pays(monkeypatch):
    monkeypatch.setattr(buffer_module, 'MAX_TRANSFORMS', 100)
    buffer = TransformBuffer(history_s=1e6)
    for k in range(60):
        buffer.add('odom', 'flood', EPOCH + k, moved(k))
    for k in range(41):
        buffer.add('odom', 'base', EPOCH + k, moved(k))
    held = {child: list(edge.stamps) for child, edge in buffer._edges.items()}
    assert held['base'] == [EPOCH + k for k in range(41)]
    assert held['flood'] == [EPOCH + k for k in range(30, 60)]
    assert (buffer.num_transforms, buffer.num_forgotten) == (71, 30)
    assert buffer.newest_ns == EPOCH + 59


def test_many_frames_are_not_all_named():
    buffer = TransformBuffer()
    for k in range(1000):
        buffer.add_static('base', f'wheel_{k}', some_pose(0))

    assert len(not_yet(buffer, 'odom', 'base', EPOCH)) < 500


# What is refused


ADDERS = [
    lambda buffer, parent, child, pose: buffer.add(parent, child, EPOCH, pose),
    lambda buffer, parent, child, pose: buffer.add_static(parent, child, pose),
]


@pytest.mark.parametrize('add', ADDERS, ids=['dynamic', 'static'])
@pytest.mark.parametrize(
    ('parent', 'child', 'named'),
    [
        ('', 'base', 'empty'),
        ('odom', '', 'empty'),
        ('odom', 'odom', 'own parent'),
        ('lidar', 'odom', 'closes the loop odom -> base -> lidar -> odom'),
        ('base', 'odom', 'closes the loop odom -> base -> odom'),
    ],
)
def test_an_edge_that_is_no_part_of_a_tree_is_refused(add, parent, child, named):
    buffer = drive()

    with pytest.raises(PoseError, match=named):
        add(buffer, parent, child, moved(0.0))

    assert buffer.lookup('odom', 'base', EPOCH + S)[0, 3] == 10.0


def test_a_static_child_takes_no_dynamic_transform_and_the_reverse():
    buffer = drive()

    with pytest.raises(PoseError, match='known as static'):
        buffer.add('base', 'lidar', EPOCH, moved(0.0))
    with pytest.raises(PoseError, match='known as dynamic'):
        buffer.add_static('odom', 'base', moved(0.0))


def test_the_newest_stamp_between_frames_is_that_of_the_edge_that_ends_first():
    buffer = TransformBuffer()
    buffer.add('map', 'odom', 3 * S, np.eye(4))  # stamped ahead, as localisation does
    buffer.add('odom', 'base', 2 * S, np.eye(4))
    buffer.add('base', 'wheel', 5 * S, np.eye(4))
    buffer.add_static('base', 'lidar', np.eye(4))
    assert buffer.newest_between('map', 'lidar') == 2 * S
    assert buffer.newest_between('lidar', 'map') == 2 * S
    assert buffer.newest_between('odom', 'map') == 3 * S
    assert buffer.newest_between('lidar', 'wheel') == 5 * S
    assert buffer.newest_between('base', 'lidar') is None
    assert buffer.newest_between('map', 'map') is None
    assert buffer.newest_beside('map', 'lidar') == 5 * S  # that of the wheel
    buffer.add('map', 'odom', 6 * S, np.eye(4))
    assert buffer.newest_beside('map', 'lidar') == 2 * S
    assert buffer.newest_beside('base', 'wheel') == 6 * S


# Gaps


def test_nothing_is_interpolated_across_a_long_gap():
    buffer = drive(max_gap_s=0.9, reset_after_s=10.0)
    text = not_yet(buffer, 'odom', 'lidar', EPOCH + S + 1)
    assert 'in a gap of 1.000 s of odom -> base' in text
    assert 'pose.max_gap_s' in text
    expected = compose(moved(10.0), some_pose(1))
    assert buffer.lookup('odom', 'lidar', EPOCH + S).tobytes() == expected.tobytes()

    buffer.add('odom', 'base', EPOCH + S + S // 2, moved(15.0))
    assert buffer.lookup('odom', 'base', EPOCH + S + S // 4)[0, 3] == pytest.approx(12.5)


def test_a_gap_as_long_as_the_limit_is_bridged():
    assert drive(max_gap_s=1.0).lookup('odom', 'base', EPOCH + S // 2)[0, 3] == 5.0


def test_a_span_is_held_if_every_stamp_within_is():
    buffer = TransformBuffer(max_gap_s=0.5)
    for tenth in (0, 2, 4, 9, 10, 12, 16, 20):  # 0.5 s between the third and the fourth
        buffer.add('odom', 'base', tenth * S // 10, np.eye(4))
    buffer.add_static('base', 'lidar', np.eye(4))
    buffer.check_span('odom', 'lidar', 0, 2 * S)
    buffer.check_span('lidar', 'odom', S // 10, S)

    buffer.max_gap_s = 0.45
    buffer.check_span('odom', 'lidar', 0, 4 * S // 10)
    buffer.check_span('odom', 'lidar', 9 * S // 10, 2 * S)
    for first, last in ((0, 2 * S), (S // 10, S), (4 * S // 10, S), (5 * S // 10, 6 * S // 10)):
        with pytest.raises(PoseNotYetError, match=r'gap of 0\.500 s'):
            buffer.check_span('odom', 'lidar', first, last)
    with pytest.raises(PosesLateError, match='newer than all'):
        buffer.check_span('odom', 'lidar', 9 * S // 10, 2 * S + 1)
    with pytest.raises(PoseError, match='older than all'):
        buffer.check_span('odom', 'lidar', -1, 0)
    with pytest.raises(PoseNotYetError, match='no transform of camera yet'):
        buffer.check_span('odom', 'camera', 0, 1)


# New parents


def test_a_new_parent_holds_from_its_stamp_on():
    buffer = TransformBuffer()
    for second in (0, 1, 2, 3):
        buffer.add('odom' if second < 2 else 'map', 'base', EPOCH + second * S, moved(second))

    assert buffer.lookup('odom', 'base', EPOCH + S // 2)[0, 3] == 0.5
    assert buffer.lookup('map', 'base', EPOCH + 5 * S // 2)[0, 3] == 2.5
    assert 'between the parents odom and map' in not_yet(
        buffer, 'odom', 'base', EPOCH + 3 * S // 2
    )
    not_yet(buffer, 'odom', 'base', EPOCH + 2 * S)
    not_yet(buffer, 'map', 'base', EPOCH + S)


def test_a_new_static_parent_holds_for_all_time():
    buffer = drive()
    buffer.add_static('base', 'mast', moved(1.0))
    buffer.add_static('mast', 'lidar', moved(2.0))

    assert buffer.lookup('odom', 'lidar', EPOCH + S)[0, 3] == 13.0
    assert buffer.move.parents == ('base', 'mast')


@pytest.mark.parametrize('seed', range(20))
def test_parents_at_a_stamp_are_as_in_a_slow_twin_in_any_order_of_arrival(seed):
    rng = np.random.default_rng(seed)
    samples = [(int(t), str(rng.choice(['a', 'b']))) for t in rng.permutation(20)]
    buffer = TransformBuffer()
    for stamp_ns, parent in samples:
        buffer.add(parent, 'base', stamp_ns * 10, moved(float(stamp_ns)))

    for asked_ns in range(0, 191, 5):
        parent = max(s for s in samples if s[0] * 10 <= asked_ns)[1]
        assert buffer.is_between('base', parent, 'base')
        if any(s[1] == parent for s in samples if s[0] * 10 >= asked_ns):
            # the twins lie on a line, so all interpolation is along it
            found = buffer.lookup(parent, 'base', asked_ns)[0, 3]
            assert found == pytest.approx(asked_ns / 10.0)
        else:
            not_yet(buffer, parent, 'base', asked_ns)
        not_yet(buffer, 'b' if parent == 'a' else 'a', 'base', asked_ns)


def test_one_stray_parent_leaves_a_gap_of_one_sample():
    buffer = drive()
    buffer.add('wrong', 'base', EPOCH + 3 * S + 1, moved(0.0))
    buffer.add('odom', 'base', EPOCH + 4 * S, moved(40.0))
    buffer.add('odom', 'base', EPOCH + 5 * S, moved(50.0))

    assert buffer.lookup('odom', 'base', EPOCH + 9 * S // 2)[0, 3] == 45.0
    assert buffer.lookup('odom', 'base', EPOCH + 5 * S // 2)[0, 3] == 25.0
    not_yet(buffer, 'odom', 'base', EPOCH + 7 * S // 2)

    buffer.forget_former_parents()
    assert buffer.lookup('odom', 'base', EPOCH + 7 * S // 2)[0, 3] == 35.0
    assert 'wrong' not in not_yet(buffer, 'odom', 'unknown', EPOCH)
    assert buffer.num_transforms == 6


@pytest.mark.parametrize('num', [4, 5])
def test_parents_in_turn_are_named_if_no_single_stray_message_makes_them(num):
    buffer = TransformBuffer()
    for second in range(num):
        buffer.add(('odom', 'map')[second % 2], 'base', EPOCH + second * S, moved(0.0))
    says = not_yet(buffer, 'map', 'base', EPOCH)
    assert ('base has in turn the parents map and odom: two pub' in says) == (num == 5)


def test_a_span_across_a_new_parent_is_refused():
    buffer = TransformBuffer()
    for second, parent in enumerate(['odom', 'odom', 'wrong', 'odom']):
        buffer.add(parent, 'base', EPOCH + second * S, moved(second))
    buffer.check_span('odom', 'base', EPOCH, EPOCH + S)
    with pytest.raises(PoseError, match='new parent'):
        buffer.check_span('odom', 'base', EPOCH, EPOCH + 3 * S)


@pytest.mark.parametrize('is_static', [True, False])
def test_a_frame_moves_to_a_parent_of_the_other_kind(is_static):
    buffer = TransformBuffer()
    for parent, kind in (('a', is_static), ('b', not is_static)):
        if kind:
            buffer.add_static(parent, 'base', moved(1.0))
        else:
            buffer.add(parent, 'base', EPOCH, moved(1.0))

    assert buffer.lookup('b', 'base', EPOCH)[0, 3] == 1.0
    not_yet(buffer, 'a', 'base', EPOCH)
    assert buffer.num_transforms == is_static
    assert buffer.newest_ns == (EPOCH if is_static else None)


def test_moves_are_new_parents_and_other_static_transforms():
    buffer = drive()
    assert buffer.move is None
    buffer.add_static('base', 'lidar', some_pose(1) + np.diag([0.0] * 3, 1) * 1e-9)
    assert buffer.move is None
    buffer.add_static('base', 'lidar', moved(2.0))
    assert buffer.move.parents == ('base', 'base')
    assert buffer.move.positions[1] == (2.0, 0.0, 0.0)
    buffer.add('wrong', 'base', EPOCH + 2 * S, moved(0.0))  # older than the newest
    assert buffer.move.child == 'lidar'
    buffer.add('wrong', 'base', EPOCH + 4 * S, moved(0.0))
    assert (buffer.move.child, buffer.move.parents) == ('base', ('odom', 'wrong'))


@pytest.mark.parametrize(
    ('step_m', 'seconds', 'is_jump'),
    [
        *[(0.19, 0.0, False), (0.21, 0.0, True), (1.1, 0.02, False), (1.3, 0.02, True)],
        *[(5.0, 0.09, False), (5.5, 0.09, True), (500.0, 0.1, False)],
    ],
)
def test_a_step_that_no_robot_makes_is_a_move(step_m, seconds, is_jump):
    buffer = drive()
    buffer.add('odom', 'base', EPOCH + 3 * S + round(seconds * S), moved(30.0 - step_m))
    assert (buffer.move is not None) == is_jump
    if is_jump:
        assert buffer.move.parents == ('odom', 'odom')
        assert buffer.move.positions == ((30.0, 0.0, 0.0), (30.0 - step_m, 0.0, 0.0))


def test_new_parents_without_end_do_not_fill_the_memory(monkeypatch):
    monkeypatch.setattr(buffer_module, 'MAX_EDGES', 5)
    buffer = TransformBuffer()
    for k in range(9):
        buffer.add(f'parent_{k}', 'base', EPOCH + k, moved(0.0))
    with pytest.raises(PoseError, match='no more are taken'):
        buffer.add('parent_9', 'base', EPOCH + 9, moved(0.0))
    buffer.forget_former_parents()
    buffer.add('parent_9', 'base', EPOCH + 9, moved(0.0))
