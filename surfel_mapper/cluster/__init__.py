# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Shelves of bags on many processes and machines: shards, partial maps, tiles, one exact map.

Sums of integers do not depend on how the scans were shared out, so the map that comes out has
the digest of the one that a single process makes, and every run proves it for itself.
"""
