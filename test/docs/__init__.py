# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The documentation: its tutorials run, its pages are in the menu, its links have targets."""
