# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Pictures, the report, a replay in rerun; matplotlib is loaded only when one is drawn."""
