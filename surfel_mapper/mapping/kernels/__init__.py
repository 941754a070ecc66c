# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Compiled loops of the exact map: reduce, insert, remove, derive, select."""

import surfel_mapper.kernels  # noqa: F401 - checks for numba, drops stale kernels
