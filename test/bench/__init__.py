# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Benchmarks: milliseconds a scan, beside other packages.

    make bench                                      all, with the environment of the project
    python -m test.bench --help                     list them
    python -m test.bench --scans 25                 smaller runs, for use while working
    python -m test.bench --only filters --peers     other packages too, from PyPI

How to read it: every row is the median, the 99th percentile and the slowest of the scans of one
run, on one core of a machine that may be shared; compare rows of one run only, and check the
load.

How to add one: write a module here with a docstring and ``run(options) -> list of rows``, a row
being a mapping of columns to values in the order to print, and name it in ``BENCHES``.
"""
