# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reading, salvaging and writing of bags.

Reading is our own code because rosbags refuses a file that is cut off, which a killed recorder
leaves, mcap and sqlite3 alike. The writer and the types of messages are those of rosbags.
"""
