# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS 2: the node, and playing bags over DDS. rclpy and messages are imported only here."""
