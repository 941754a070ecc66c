# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings through the pipeline, the files that a replay writes, and surveys of bags."""
