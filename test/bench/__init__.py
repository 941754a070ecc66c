# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Benchmarks: milliseconds a scan, beside other packages.

    make bench                                      all, with the environment of the project
    python -m test.bench --help                     which there are
    python -m test.bench --quick                    smaller ones, to see a change while working
    python -m test.bench --only compare --peers     others too, from PyPI, in their environments

How to read it: every row is the median, the 99th percentile and the slowest of the scans of one
run, on one core of a machine that others may be using; compare rows of one run only, and look at
the load. Budgets are for a quiet machine and are stated, not asserted.

How to add one: write a module here with a docstring and ``run(options) -> list of rows``, a row
being a mapping of columns to values in the order to print, and name it in ``BENCHES``.
"""
