# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Workers that come, go and die change nothing in the map; real Dask clusters of this machine."""

from multiprocessing import forkserver
import os
from pathlib import Path
import random
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from surfel_mapper.cluster import executors
from surfel_mapper.cluster.executors import open_executor, SerialExecutor
from surfel_mapper.cluster.map_reduce import map_bags
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


def what_is_there():
    """Return whether all that tasks need is loaded, Ctrl-C ignored, and what libraries read."""
    modules = ('surfel_mapper.cluster.shards', 'surfel_mapper.mapping.kernels.reduction')
    return (
        all(name in sys.modules for name in modules),
        signal.getsignal(signal.SIGINT) is signal.SIG_IGN,
        os.environ.get('MALLOC_ARENA_MAX'),
    )


def kill_one(executor):
    """Kill a worker that is at a task, and return its process."""
    client = executor._client
    pids = client.run(os.getpid)
    busy = [address for address, tasks in client.processing().items() if tasks]
    victim = pids[busy[0] if busy else next(iter(pids))]
    os.kill(victim, signal.SIGKILL)
    return victim


@pytest.fixture(scope='module')
def two_workers():
    with open_executor(workers=2) as executor:
        yield executor


@pytest.fixture(scope='module')
def case(tmp_path_factory):
    bag, config = written(tmp_path_factory.mktemp('bags'), 'plain')
    return shards_of(bag, config, 0.5), in_one_go(bag, config).map.digest()


def test_every_task_is_answered_under_its_number(two_workers):
    for executor in (two_workers, SerialExecutor()):
        answers = dict(executor.run(squared, range(7)))
        assert answers == {number: number * number for number in range(7)}
    assert two_workers.num_workers == 2


def test_workers_start_with_the_modules_of_all_tasks(two_workers):
    assert set(two_workers._client.run(what_is_there).values()) == {(True, True, '1')}


def test_ctrl_c_while_workers_begin_ends_them_when_they_have_begun(monkeypatch):
    import distributed

    made = []

    class Interrupted(distributed.LocalCluster):
        def __init__(self, *args, **kwargs):
            made.append(self)
            signal.raise_signal(signal.SIGINT)
            super().__init__(*args, **kwargs)

    monkeypatch.setattr(distributed, 'LocalCluster', Interrupted)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), open_executor(workers=1):
        pytest.fail('it has begun')
    assert made[0].status is distributed.Status.closed
    assert signal.getsignal(signal.SIGINT) is before


def children(pid):
    try:
        return [*map(int, Path(f'/proc/{pid}/task/{pid}/children').read_text().split())]
    except OSError:
        return []


@pytest.mark.skipif(not os.path.exists('/proc/self/status'), reason='processes are not shown')
def test_a_worker_killed_while_it_starts_is_an_error_that_says_so():
    """The first process that the fork server makes is a worker."""
    killed, is_over = [], threading.Event()

    def kill_first():
        while not killed and not is_over.is_set():
            fresh = {*children(forkserver._forkserver._forkserver_pid or 0)} - {*others}
            for pid in fresh:
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)
            time.sleep(0.002)

    others = children(forkserver._forkserver._forkserver_pid or 0)  # workers of other tests
    thread = threading.Thread(target=kill_first)
    thread.start()
    try:
        with (
            pytest.raises(ClusterError, match='a worker ended while it started'),
            open_executor(workers=2),
        ):
            pytest.fail('it has begun')
    finally:
        is_over.set()
        thread.join()
    assert killed


@pytest.mark.skipif(not os.path.exists('/proc/net/tcp'), reason='sockets are not shown')
def test_local_workers_are_encrypted_and_listen_on_loopback_only(two_workers):
    import distributed

    info = two_workers._client.scheduler_info(n_workers=-1)
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
    pids = {os.getpid(), *executor._client.run(os.getpid).values()}
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


FORKSERVER = """
from multiprocessing import forkserver
from pathlib import Path
from surfel_mapper.cluster.executors import start_forkserver
assert start_forkserver() == 'forkserver'
words = Path(f'/proc/{forkserver._forkserver._forkserver_pid}/status').read_text().split()
print(words[words.index('SigIgn:') + 1])
"""


@pytest.mark.skipif(not os.path.exists('/proc/self/status'), reason='signals are not shown')
def test_the_fork_server_ignores_ctrl_c_from_its_start():
    done = subprocess.run(
        [sys.executable, '-c', FORKSERVER], capture_output=True, text=True, check=True
    )
    assert int(done.stdout, 16) >> (signal.SIGINT - 1) & 1


def test_the_environment_is_left_as_it_was(monkeypatch):
    monkeypatch.setenv('SURFEL_MAPPER_A', 'old')
    monkeypatch.delenv('SURFEL_MAPPER_B', raising=False)
    with executors.environment({'SURFEL_MAPPER_A': 'new', 'SURFEL_MAPPER_B': 'new'}):
        assert os.environ['SURFEL_MAPPER_A'] == os.environ['SURFEL_MAPPER_B'] == 'new'
    assert os.environ['SURFEL_MAPPER_A'] == 'old'
    assert 'SURFEL_MAPPER_B' not in os.environ


def test_two_workers_make_the_map_of_one_process(two_workers, case, tmp_path):
    shards, digest = case
    mapped = map_bags(shards, two_workers, tmp_path)
    assert mapped.map.digest == digest
    assert mapped.counts()['scans']['mapped'] == 60


@pytest.mark.parametrize('stage', ['map', 'merge'])
def test_killing_a_worker_in_the_middle_changes_nothing(two_workers, case, tmp_path, stage):
    shards, digest = case
    victims = []

    def kill_once(kind, amount):
        if kind == stage and not victims:
            victims.append(kill_one(two_workers))

    mapped = map_bags(shards, two_workers, tmp_path, kill_once)

    assert len(victims) == 1
    assert victims[0] not in two_workers._client.run(os.getpid).values()
    assert mapped.map.digest == digest
    assert mapped.counts()['scans']['mapped'] == 60
    assert [path.name for path in tmp_path.iterdir()] == ['map']


def test_an_error_of_a_task_comes_back_as_it_is(two_workers):
    with pytest.raises(ClusterError, match='not this one'):
        list(two_workers.run(refuse, [1]))


def test_a_task_that_kills_its_workers_is_given_up(monkeypatch):
    monkeypatch.setattr(executors, 'LOSSES', 0)
    with open_executor(workers=1) as executor, pytest.raises(ClusterError, match='workers died'):
        list(executor.run(die, [1]))


def test_a_scheduler_elsewhere_is_used(case, tmp_path):
    from distributed import LocalCluster

    shards, digest = case
    with (
        LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address='127.0.0.1:0'
        ) as cluster,
        open_executor(scheduler=cluster.scheduler_address) as executor,
    ):
        assert map_bags(shards, executor, tmp_path).map.digest == digest


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
        with dask.config.set(settings), open_executor(scheduler=address) as executor:
            assert dict(executor.run(squared, [3])) == {0: 9}
        with (
            pytest.raises(ClusterError, match='no Dask scheduler answers'),
            open_executor(scheduler=address),
        ):
            pytest.fail('it has begun')


def test_a_scheduler_without_workers_is_refused():
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=0, dashboard_address='127.0.0.1:0') as cluster,
        pytest.raises(ClusterError, match='no workers'),
        open_executor(scheduler=cluster.scheduler_address),
    ):
        pass


@pytest.mark.parametrize('address', ['tcp://127.0.0.1:1', 'nonsense://x'])
def test_a_scheduler_that_does_not_answer_is_refused_by_name(monkeypatch, address):
    monkeypatch.setattr(executors, 'CONNECT_S', 1)
    with pytest.raises(ClusterError, match=address), open_executor(scheduler=address):
        pass


@pytest.mark.parametrize(
    'answer',
    [None, b'', b'HTTP/1.0 400 Bad Request\r\n\r\n', random.Random(2).randbytes(4096)],
    ids=['silence', 'closed', 'http', 'garbage'],
)
def test_a_server_that_is_no_scheduler_is_refused_by_name(monkeypatch, answer):
    """Silence was waited for without end; answers of others became lengths of arrays."""
    monkeypatch.setattr(executors, 'CONNECT_S', 2)
    accepted = []

    def serve():
        while True:
            connection, _ = server.accept()
            accepted.append(connection)
            if answer is not None:
                connection.sendall(answer)
            if answer == b'':
                connection.close()

    with socket.create_server(('127.0.0.1', 0)) as server:
        address = f'tcp://127.0.0.1:{server.getsockname()[1]}'
        threading.Thread(target=serve, daemon=True).start()
        with pytest.raises(ClusterError, match=address), open_executor(scheduler=address):
            pytest.fail('it has begun')
        for connection in accepted:
            connection.close()
