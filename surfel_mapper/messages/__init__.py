# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Bytes of ROS messages to arrays and back; loads no ROS."""
