# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS 2: the node, and the player of bags. Only this package imports rclpy and message classes."""
