"""``sensor_msgs/JointState`` as the stage's drivers use it: the layout of its messages, and messages from arrays."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import RecordError
from slpi_ros.io.cdr import CdrBuilder, CdrLayout

SECOND_NS = 1_000_000_000

# header stamps count seconds in int32
_STAMP_END = 2**31 * SECOND_NS


@dataclass(frozen=True)
class JointStateBlock:
    """Many messages of one layout.

    Parameters
    ----------
    stamp_ns : ndarray of int64, shape (N,), nanoseconds
        Header stamps.
    position : ndarray, shape (N, K), metres
        One column for each joint.
    effort : ndarray, shape (N, K), volts
        One column for each joint; the stage's drivers put the applied voltage here.
    """

    stamp_ns: NDArray[np.int64]
    position: NDArray[np.float64]
    effort: NDArray[np.float64]


@lru_cache(maxsize=64)
def joint_state_layout(names: tuple[str, ...], frame_id: str = "", velocities: int = 0) -> CdrLayout:
    """Return the layout of messages with these names.

    Parameters
    ----------
    names : tuple of str, length K
        Joint names, each with one position and one effort.
    frame_id : str
        As in the header.
    velocities : int
        Length of the array ``velocity``, which is not read.

    Returns
    -------
    CdrLayout
        Shared between callers: do not write to its arrays.
    """
    if not names:
        raise RecordError("a stage_state message needs at least one axis name")
    builder = CdrBuilder()
    builder.header(frame_id)
    builder.count(len(names))
    for name in names:
        builder.string(name)
    builder.sequence("position", len(names))
    builder.sequence("velocity", velocities)
    builder.sequence("effort", len(names))
    return builder.layout()


def encode_joint_states(block: JointStateBlock, names: tuple[str, ...], frame_id: str = "") -> list[bytes]:
    """Return one serialised message for each stamp.

    Parameters
    ----------
    block : JointStateBlock
        What they hold.
    names : tuple of str, length K
        Joint names.
    frame_id : str
        As in the header.

    Raises
    ------
    RecordError
        If a stamp does not fit into a header: before 1970 or after 2038.
    """
    unfit = (block.stamp_ns < 0) | (block.stamp_ns >= _STAMP_END)
    if unfit.any():
        raise RecordError(
            f"sample {int(unfit.argmax())}: time {block.stamp_ns[unfit][0] / SECOND_NS:g} s does not "
            "fit into a message stamp (0 to 2^31 s); shift the time axis"
        )
    layout = joint_state_layout(names, frame_id)
    size = layout.template.size
    data = np.tile(layout.template, block.stamp_ns.size)
    fields = data.view(layout.dtype(size))
    fields["sec"], fields["nanosec"] = np.divmod(block.stamp_ns, SECOND_NS)
    fields["position"], fields["effort"] = block.position, block.effort
    stream = data.tobytes()
    return [stream[start : start + size] for start in range(0, len(stream), size)]
