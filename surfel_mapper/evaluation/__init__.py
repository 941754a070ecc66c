# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of a map against a world of known surfaces, a cloud, or another map."""
