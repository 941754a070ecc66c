# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Compiled sums over the pairs of LUM edges and the cells of a registration."""

import surfel_mapper.kernels  # noqa: F401 - checks for numba, drops stale kernels
