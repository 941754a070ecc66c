# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Any input gives a result or an error of this package, in bounded memory and time.

Each harness is a function of bytes. The tests feed it its corpus and seeded mutations of it.
"""
