# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The exact core: surfels, the map of them, and the window of scans that the map holds."""
