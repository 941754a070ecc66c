# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Imports of the fork server: all modules that a task needs, with their kernels loaded.

On its own because the fork server imports it by name, once for any number of workers, which share
its memory. It must start no thread, because threads do not survive a fork; pyarrow starts some and
is left out.

Ctrl-C reaches all processes of a terminal. It is meant for the process that asked for workers,
which ends them; so here and in all forked processes it is ignored.
"""

from contextlib import suppress
import signal

signal.signal(signal.SIGINT, signal.SIG_IGN)

from surfel_mapper.errors import SurfelMapperError  # noqa: E402 - Ctrl-C may come meanwhile

with suppress(SurfelMapperError):  # a worker meets the same error, and reports it
    from surfel_mapper.cluster import shards, tiles  # noqa: F401 - for the workers
    from surfel_mapper.pipeline import Mapper

    Mapper().warm_up()
