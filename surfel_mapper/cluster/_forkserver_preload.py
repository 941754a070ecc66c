# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Imports of the fork server: the modules that tasks need, once for all workers of this machine.

It starts no thread, because threads do not survive a fork. The process that asked for workers ends
them at Ctrl-C, so all others ignore it.
"""

from contextlib import suppress
import signal

signal.signal(signal.SIGINT, signal.SIG_IGN)

from surfel_mapper.errors import SurfelMapperError  # noqa: E402 - Ctrl-C may come meanwhile

with suppress(SurfelMapperError):  # a worker meets the same error, and reports it
    from surfel_mapper.cluster import shards  # noqa: F401 - for the workers
    from surfel_mapper.pipeline import Mapper

    Mapper().warm_up()
