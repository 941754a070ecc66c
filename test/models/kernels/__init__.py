# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Tests of the kernels of surfel_mapper/models against slow twins and analytic results."""
