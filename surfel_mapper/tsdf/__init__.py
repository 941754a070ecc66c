# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A truncated signed distance field fused from range images, kept in hashed blocks of voxels."""
