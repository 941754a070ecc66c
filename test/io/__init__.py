# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The tests, in the tree of the package; reference.py holds its slow twins, bench/ its speed."""
