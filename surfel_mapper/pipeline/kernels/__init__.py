# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Compiled loop over the points of a region."""

import surfel_mapper.kernels  # noqa: F401 - checks for numba, drops stale kernels
