"""A decaying oscillation, after which the memory is known whatever it was before."""

from slpi_ros.errors import UsageError
from slpi_ros.model.stream import Limits


def decaying_turns(limits: Limits, final: float, cycles: int) -> list[float]:
    """Return the voltages (V) at which a decaying oscillation turns, the final one last.

    The first cycle reaches both limits and closes every loop between them. The amplitude then falls by the same
    amount each cycle, on either side of the final voltage by as much as there is room.

    Parameters
    ----------
    limits : Limits
    final : float, volts
        Within the limits.
    cycles : int
        At least 1.

    Raises
    ------
    UsageError
        If there is no cycle, or the final voltage is outside.
    """
    if cycles < 1 or not limits.lower <= final <= limits.upper:
        raise UsageError(
            f"a reset of {cycles} cycles to {final:g} V within {limits.lower:g}..{limits.upper:g} V; "
            "give at least one cycle and a final voltage within the limits"
        )
    above, below = limits.upper - final, limits.lower - final
    # Which limit came first must not matter: the upper one is visited once more.
    turns = [limits.upper, limits.lower]
    for left in range(cycles, 0, -1):
        share = left / cycles
        turns += [final + share * above, final + share * below]
    return [*(limits.clip(v) for v in turns), final]
