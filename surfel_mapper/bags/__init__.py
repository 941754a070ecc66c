# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reading and writing of bags.

rosbags reads and writes whole bags. It refuses an mcap file that a killed recorder left without
its index; the mcap package reads that up to the cut.
"""
