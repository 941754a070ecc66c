# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Tests of the TSDF layer; the numbers T1 to T21 are those of its specification."""
