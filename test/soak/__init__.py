# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Long runs: does anything grow, slow down or drift? Not part of the tests; see ``make soak``."""
