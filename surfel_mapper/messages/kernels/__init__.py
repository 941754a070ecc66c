# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Kernels that fill messages."""

import surfel_mapper.kernels  # noqa: F401 - checks for numba, drops stale kernels
