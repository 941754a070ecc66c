# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Workers that come, go and die change nothing in the map; real Dask clusters of this machine."""

import os
from pathlib import Path
import random
import signal
import socket

import pytest

from surfel_mapper.cluster import workers
from surfel_mapper.cluster.map_reduce import map_bags
from surfel_mapper.cluster.workers import open_workers, Workers
from surfel_mapper.errors import ClusterError
from test import extras
from test.cluster.bags import in_one_go, shards_of, written

pytestmark = extras.needs('distributed')


def squared(number):
    return number * number


def die(_):
    os._exit(1)


def refuse(_):
    raise ClusterError('not this one')


def kill_one(executor):
    """Kill a worker that is at a task, and return its process."""
    client = executor.client
    pids = client.run(os.getpid)
    busy = [address for address, tasks in client.processing().items() if tasks]
    victim = pids[busy[0] if busy else next(iter(pids))]
    os.kill(victim, signal.SIGKILL)
    return victim


@pytest.fixture(scope='module')
def two_workers():
    with open_workers(workers=2) as executor:
        yield executor


@pytest.fixture(scope='module')
def case(tmp_path_factory):
    bag, config = written(tmp_path_factory.mktemp('bags'), 'plain')
    return shards_of(bag, config, 0.5), in_one_go(bag, config).map.digest()


def test_every_task_is_answered_under_its_number(two_workers):
    for executor in (two_workers, Workers()):
        answers = dict(executor.run(squared, range(7)))
        assert answers == {number: number * number for number in range(7)}
    assert two_workers.num_workers == 2


@pytest.mark.skipif(not os.path.exists('/proc/net/tcp'), reason='sockets are not shown')
def test_local_workers_are_encrypted_and_listen_on_loopback_only(two_workers):
    import distributed

    info = two_workers.client.scheduler_info(n_workers=-1)
    workers = info['workers']
    assert all(address.startswith('tls://127.0.0.1:') for address in (info['address'], *workers))
    assert {address for address, _ in listened(two_workers)} == {'0100007F'}
    with pytest.raises(OSError, match=r'127\.0\.0\.1'):
        distributed.Client(info['address'].replace('tls:', 'tcp:'), timeout=2)
    stranger = distributed.Security.temporary()
    with pytest.raises(OSError, match='TLS certificate does not match'):
        distributed.Client(info['address'], timeout=2, security=stranger)
    assert dict(two_workers.run(squared, [3])) == {0: 9}


@pytest.mark.skipif(not os.path.exists('/proc/net/tcp'), reason='sockets are not shown')
def test_strangers_get_no_page_and_end_nothing(two_workers):
    """Dask serves pages over HTTP without keys: of tasks, their arguments, the processes."""
    paths = '/', '/info/main/workers.html', '/json/counts.json', '/health', '/metrics', '/status'
    requests = [f'GET {path} HTTP/1.0\r\n\r\n'.encode() for path in paths]
    noise = random.Random(1).randbytes(70_000)
    waiting, refused = [], []
    for _, port in sorted(listened(two_workers)):
        for sent in (*requests, noise, b'\x16\x03\x01\xff\xff' + noise, bytes(70_000), b''):
            with socket.create_connection(('127.0.0.1', port)) as stranger:
                refused.append(is_refused(stranger, sent))
        waiting += [socket.create_connection(('127.0.0.1', port)) for _ in range(50)]
    assert refused
    assert all(refused)
    assert dict(two_workers.run(squared, range(7))) == {n: n * n for n in range(7)}
    for stranger in waiting:
        stranger.close()


def is_refused(stranger, sent):
    """Send bytes; return whether the connection ends, with an error of HTTP or of TLS, or none."""
    stranger.settimeout(60.0)
    try:
        stranger.sendall(sent)
        stranger.shutdown(socket.SHUT_WR)
        answer = b''.join(iter(lambda: stranger.recv(1 << 16), b''))
    except TimeoutError:
        return False
    except OSError:  # the other end was faster
        return True
    return not answer or answer[:12] in (b'HTTP/1.1 400', b'HTTP/1.1 404') or answer[0] == 0x15


def listened(executor):
    """Return address and port of the sockets of a cluster, the former hexadecimal as in /proc."""
    pids = {os.getpid(), *executor.client.run(os.getpid).values()}
    links = [link for pid in pids for link in Path(f'/proc/{pid}/fd').iterdir()]
    names = (os.readlink(link) for link in links if link.is_symlink())
    inodes = {name[8:-1] for name in names if name.startswith('socket:[')}
    rows = [
        line.split()
        for name in ('tcp', 'tcp6')
        for line in Path('/proc/net', name).read_text().splitlines()[1:]
    ]
    found = (row[1].split(':') for row in rows if row[3] == '0A' and row[9] in inodes)
    return {(address, int(port, 16)) for address, port in found}


def test_killing_a_worker_in_the_middle_changes_nothing(two_workers, case):
    shards, digest = case
    victims = []

    def kill_once(seconds):
        if not victims:
            victims.append(kill_one(two_workers))

    mapped = map_bags([shards], two_workers, kill_once)

    assert len(victims) == 1
    assert victims[0] not in two_workers.client.run(os.getpid).values()
    assert mapped.mapper.map.digest() == digest
    assert mapped.counts['scans']['mapped'] == 60


def test_an_error_of_a_task_comes_back_as_it_is(two_workers):
    with pytest.raises(ClusterError, match='not this one'):
        list(two_workers.run(refuse, [1]))


def test_a_task_that_kills_its_workers_is_given_up():
    with open_workers(workers=1) as executor, pytest.raises(ClusterError, match='workers died'):
        list(executor.run(die, [1]))


def test_a_scheduler_elsewhere_is_used(case):
    from distributed import LocalCluster

    shards, digest = case
    with (
        LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address='127.0.0.1:0'
        ) as cluster,
        open_workers(scheduler=cluster.scheduler_address) as executor,
    ):
        assert map_bags([shards], executor).mapper.map.digest() == digest


def test_a_scheduler_with_tls_is_used_with_the_keys_in_the_settings_of_dask(tmp_path):
    import dask
    import distributed

    security = distributed.Security.temporary()
    certificate, key = tmp_path / 'node.pem', tmp_path / 'node.key'
    certificate.write_text(security.tls_ca_file)
    key.write_text(security.tls_client_key)
    settings = {
        'distributed.comm.tls.ca-file': str(certificate),
        'distributed.comm.tls.client.cert': str(certificate),
        'distributed.comm.tls.client.key': str(key),
    }
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, security=security, dashboard_address='127.0.0.1:0'
    ) as cluster:
        address = cluster.scheduler_address
        assert address.startswith('tls://')
        with dask.config.set(settings), open_workers(scheduler=address) as executor:
            assert dict(executor.run(squared, [3])) == {0: 9}
        with (
            pytest.raises(ClusterError, match='no Dask scheduler answers'),
            open_workers(scheduler=address),
        ):
            pytest.fail('it has begun')


def test_a_scheduler_without_workers_is_refused():
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=0, dashboard_address='127.0.0.1:0') as cluster,
        pytest.raises(ClusterError, match='no workers'),
        open_workers(scheduler=cluster.scheduler_address),
    ):
        pass


@pytest.mark.parametrize('address', ['tcp://127.0.0.1:1', 'nonsense://x'])
def test_a_scheduler_that_does_not_answer_is_refused_by_name(monkeypatch, address):
    monkeypatch.setattr(workers, 'CONNECT_S', 1)
    with pytest.raises(ClusterError, match=address), open_workers(scheduler=address):
        pass
