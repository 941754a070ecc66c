# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Many bags on many processes and machines: shards, partial maps, one exact map.

Sums of integers do not depend on how the scans are distributed, so the map has the digest of the
map that a single process makes.
"""
