# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Imported by the process that local workers are forked from: all that a task needs, kernels loaded.

It is loaded once for any number of workers, who share its memory. It must start no thread, which
would not live on in a worker; pyarrow does, and is left out.
"""

from contextlib import suppress

from surfel_mapper.errors import SurfelMapperError

with suppress(SurfelMapperError):  # a worker meets it again, and says so
    from surfel_mapper.cluster import merging, shards  # noqa: F401 - for the workers
    from surfel_mapper.pipeline import Mapper

    Mapper().warm_up()
