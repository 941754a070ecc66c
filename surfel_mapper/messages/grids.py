# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""nav_msgs/OccupancyGrid as bytes. On its own: it shares no code with other messages."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.messages.cdr import MessageWriter, write_header


def occupancy_grid(
    resolution_m: float,
    origin: npt.NDArray[np.float64],
    cost: npt.NDArray[np.int8],
    *,
    stamp_ns: int,
    frame_id: str,
) -> bytes:
    """
    Return the serialised nav_msgs/OccupancyGrid of costs.

    Parameters
    ----------
    resolution_m : float
        Edge of a cell.
    origin : (2,) float64, m
        x and y of the outer corner of the first cell.
    cost : (rows along y, columns along x) int8
        0 free to 100 occupied, -1 unknown.
    stamp_ns : int
        Stamp of the message, and the time at which the map was loaded.
    frame_id : str
        Frame of the grid.

    """
    writer = MessageWriter()
    write_header(writer, stamp_ns, frame_id)
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    writer.numbers('i', seconds)
    writer.numbers('I', nanoseconds)
    writer.numbers('f', resolution_m)
    rows, columns = cost.shape
    writer.numbers('I', columns, rows)
    writer.numbers('d', *origin.tolist(), 0.0, 0.0, 0.0, 0.0, 1.0)  # position, q_xyzw
    writer.sequence(cost.reshape(-1), 'i1')
    return writer.join()
