# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Imported by the process that local workers are forked from: all that a task needs, kernels loaded.

It is loaded once for any number of workers, who share its memory. It must start no thread, which
would not live on in a worker; pyarrow does, and is left out.

Ctrl-C reaches all processes of a terminal. It is for the one that asked for workers, which ends
them; so here and in all that are forked it is ignored.
"""

from contextlib import suppress
import signal

signal.signal(signal.SIGINT, signal.SIG_IGN)

from surfel_mapper.errors import SurfelMapperError  # noqa: E402 - Ctrl-C may come meanwhile

with suppress(SurfelMapperError):  # a worker meets it again, and says so
    from surfel_mapper.cluster import merging, shards  # noqa: F401 - for the workers
    from surfel_mapper.pipeline import Mapper

    Mapper().warm_up()
