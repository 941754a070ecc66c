# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The services of a node over DDS, compared with the same calls of a Mapper without ROS."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from geometry_msgs.msg import Point32, PolygonStamped
from nav_msgs.srv import LoadMap
from rclpy.parameter import Parameter

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError, PoseError
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.regions import Ball, Box, Prism
from surfel_mapper.ros.services import prism
from test.messages.pose_messages import poses_in
from test.ros.driving import ARGUMENTS, drive, mapped, PERIOD_NS, send
from test.ros.live import NODE, stamp, START_NS

ANSWERS = LoadMap.Response
SQUARE = ((-1.0, -1.0), (2.0, -1.0), (2.0, 1.5), (-1.0, 1.5))
"""Corners in base_link, which drive() moves by 0.2 m per scan."""


@pytest.fixture
def node(start, peer, tmp_path):
    """Return a node that saves to a folder of the test; clouds and odometry are advertised."""
    node = start('node', *ARGUMENTS, '-p', f'output.directory:={tmp_path / "maps"}')
    peer.advertise('/odom', '/points')
    return node


def feed(peer, num_scans):
    """Send scans to the node; return a Mapper that has mapped the same."""
    messages = drive(num_scans)
    send(peer, messages)
    peer.diagnosis({'scans.mapped': num_scans})
    return mapped(messages)[1]


def send_more(peer, twin, first, num_scans):
    """Send further scans to the node and to the twin."""
    from surfel_mapper.messages.pointcloud2 import to_scan

    for points, pose in drive(first + num_scans)[first:]:
        send(peer, [(points, pose)])
        for found in poses_in('odometry', pose, 'base_link'):
            twin.add_pose(*found)
        twin.add_scan(to_scan(points))
        for _ in twin.insert_ready():
            pass
    return peer.diagnosis({'scans.mapped': first + num_scans})


def digest(peer):
    """Return the digest that the node states for its map."""
    saved = peer.call('save_map')
    assert saved.success, saved.message
    return saved.message.rpartition('digest ')[2]


def test_clear_box_removes_voxels_and_later_evictions_stay_exact(peer, node):
    twin = feed(peer, 3)
    refused = peer.call('clear_box')
    assert not refused.success
    assert 'expected low below high' in refused.message

    box = [-1.0, -1.0, -2.0, 2.0, 1.5, 0.0]
    client = peer.parameters()
    changed = client.set_parameters([Parameter('clear.box', value=box)])
    assert peer.result(changed).results[0].successful
    before = twin.map.num_voxels
    twin.clear_region(Box(tuple(box[:3]), tuple(box[3:])))
    answer = peer.call('clear_box')

    assert answer.success, answer.message
    gone = before - twin.map.num_voxels
    assert gone > 10
    assert answer.message == (
        f'cleared {gone:,} voxels in clear.box from (-1.0, -1.0, -2.0) to (2.0, 1.5, 0.0)'
    )
    assert digest(peer) == twin.map.digest()
    _, values = send_more(peer, twin, 3, 2)  # evicts two scans that have lost voxels
    assert values['window_scans'] == '3'
    assert digest(peer) == twin.map.digest()
    assert 'Traceback' not in node.output


def test_clear_radius_removes_voxels_about_the_sensor(peer, node):
    nowhere = peer.call('clear_radius')
    assert not nowhere.success
    assert 'no scan in the map yet' in nowhere.message
    twin = feed(peer, 2)
    center = tuple(twin.window.newest.T_map_sensor[:3, 3].tolist())
    before = twin.map.num_voxels
    twin.clear_region(Ball(center, 2.0))

    answer = peer.call('clear_radius')

    gone = before - twin.map.num_voxels
    assert gone > 10
    where = '2 m about the sensor at (0.30, 0.00, 0.50)'
    assert answer.message == f'cleared {gone:,} voxels in {where}'
    assert digest(peer) == twin.map.digest()


def polygon(corners, frame_id, stamp_ns=0):
    message = PolygonStamped()
    message.header.frame_id = frame_id
    stamp(message, stamp_ns)
    message.polygon.points = [Point32(x=float(x), y=float(y)) for x, y in corners]
    return message


def test_clear_polygon_accepts_any_known_frame(peer, node):
    polygons = peer.node.create_publisher(PolygonStamped, f'{NODE}/clear_polygon', 10)
    twin = feed(peer, 3)
    peer.spin_until(polygons.get_subscription_count)
    before = twin.map.num_voxels
    # at the stamp of the second scan the base was 0.2 m along x
    twin.clear_region(Prism(tuple((x + 0.2, y) for x, y in SQUARE)))
    twin.clear_region(Prism(SQUARE))

    polygons.publish(polygon(SQUARE[:2], 'odom'))
    polygons.publish(polygon(SQUARE, 'elsewhere'))
    polygons.publish(polygon(SQUARE, 'base_link', START_NS + PERIOD_NS))
    polygons.publish(polygon(SQUARE, 'odom'))

    after = twin.map.num_voxels
    assert after < before
    peer.diagnosis({'voxels': after})
    assert digest(peer) == twin.map.digest()
    assert "in frame 'odom' ignored: polygon of 2 corners, expected 3 " in node.output
    assert f'voxels in the polygon on {NODE}/clear_polygon in frame base_link' in node.output


@pytest.mark.parametrize(
    ('corner', 'frame_id', 'error', 'reason'),
    [
        ((0.0, 0.0), '', PoseError, 'frame_id is empty'),
        ((0.0, 0.0), '/', PoseError, 'frame_id is empty'),
        ((0.0, 0.0), 'x' * 10**4, CloudFormatError, 'of 10000 characters'),
        ((0.0, 0.0), 'elsewhere', PoseError, 'elsewhere'),
        ((float('nan'), 0.0), 'odom', ValueError, 'finite numbers'),
    ],
)
def test_an_invalid_polygon_is_refused(corner, frame_id, error, reason):
    with pytest.raises(error, match=reason):
        prism(polygon([corner, (1.0, 0.0), (1.0, 1.0)], frame_id), Mapper(Config()))


def test_a_loaded_map_continues_where_it_was_saved(peer, node, tmp_path):
    twin = feed(peer, 3)
    saved = digest(peer)
    assert saved == twin.map.digest()
    assert peer.call('clear').success
    assert peer.diagnosis({'voxels': 0})

    for url in ('', 'map', 'map.npz', str(tmp_path / 'maps' / 'map.npz')):
        answer = peer.call('load_map', LoadMap, LoadMap.Request(map_url=url))
        assert answer.result == ANSWERS.RESULT_SUCCESS, node.output
        assert (answer.map.header.frame_id, answer.map.info.resolution) == ('odom', 0.5)
    url = (tmp_path / 'maps' / 'map.npz').as_uri()
    assert peer.call('load_map', LoadMap, LoadMap.Request(map_url=url)).result == 0

    assert f'surfels of 3 scans, digest {saved}' in node.output
    assert digest(peer) == saved
    send_more(peer, twin, 3, 2)
    assert digest(peer) == twin.map.digest()


def test_a_failed_load_states_the_reason_and_changes_nothing(peer, node, start, tmp_path):
    twin = feed(peer, 2)
    (tmp_path / 'secret.npz').write_bytes(b'not for everybody')
    assert peer.call('save_map').success
    maps = tmp_path / 'maps'
    (maps / 'damaged.npz').write_bytes((maps / 'map.npz').read_bytes()[:-100])
    (maps / 'link.npz').symlink_to(tmp_path / 'secret.npz')

    def load(url):
        return peer.call('load_map', LoadMap, LoadMap.Request(map_url=url)).result

    assert load('nowhere') == ANSWERS.RESULT_MAP_DOES_NOT_EXIST
    assert load('damaged') == ANSWERS.RESULT_INVALID_MAP_DATA
    for url in ('../secret', str(tmp_path / 'secret.npz'), 'link', 'http://there/map.npz', '/'):
        assert load(url) == ANSWERS.RESULT_UNDEFINED_FAILURE, url
    assert node.output.count('not inside output.directory') == 3
    assert digest(peer) == twin.map.digest()
    node.stop()

    other = start(
        'node', *ARGUMENTS, '-p', f'output.directory:={maps}', '-p', 'map.voxel_size_m:=0.25'
    )
    assert load('map') == ANSWERS.RESULT_INVALID_MAP_METADATA
    assert 'voxel_size_m 0.5, expected 0.25 as configured' in other.output
