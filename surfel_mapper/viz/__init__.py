# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of maps; matplotlib is loaded only when one is drawn."""
