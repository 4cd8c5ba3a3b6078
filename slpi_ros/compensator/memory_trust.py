"""What the memory of an axis is worth, and why it is not worth more."""

from dataclasses import dataclass, replace

# Nobody knows where the stage has been; being wiped; wiped since; kept over a restart.
ASSUMED, RESETTING, KNOWN, RESTORED = "assumed", "resetting", "known", "restored"
# A drive may miss either end of the identified voltages by this share of their span: measured ends are noisy.
TOLERATED_SHARE = 0.01


@dataclass(frozen=True)
class MemoryTrust:
    """How far a memory is to be trusted.

    Parameters
    ----------
    state : str
        `ASSUMED`, `RESETTING`, `KNOWN` or `RESTORED`.
    doubt : str
        Why it is assumed, where there is more to say than that nobody knows.
    spanned : (float, float), volts
        Lowest and highest voltage of the drive that made it known.
    """

    state: str = ASSUMED
    doubt: str = ""
    spanned: tuple[float, float] = (0.0, 0.0)

    def over(self, identified: tuple[float, float]) -> "MemoryTrust":
        """Return what it is worth for a model identified on these voltages (V).

        Loops wider than the drive are not wiped by it: what the stage did there before still counts.
        """
        (low, high), (lowest, highest) = self.spanned, identified
        margin = TOLERATED_SHARE * (highest - lowest)
        if self.state not in (KNOWN, RESTORED) or (low <= lowest + margin and highest - margin <= high):
            return self
        doubt = (
            f"wiped from {low:.6g} to {high:.6g} V only, while the model was identified from {lowest:.6g} to "
            f"{highest:.6g} V; reset it within wider voltage limits, or identify within these"
        )
        return replace(self, state=ASSUMED, doubt=doubt)
