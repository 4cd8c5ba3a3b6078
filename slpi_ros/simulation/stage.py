"""A simulated stage of one or more axes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from slpi_ros.errors import UsageError
from slpi_ros.simulation.parameters import StageParameters
from slpi_ros.simulation.preisach import PreisachStage


class Stage:
    """Axes that move independently; each is a hysteresis element with a sensor.

    Parameters
    ----------
    axes : mapping of axis name to PreisachStage
        In the order in which voltages are given.

    Attributes
    ----------
    axes : dict of axis name to PreisachStage
        As given.

    Raises
    ------
    UsageError
        If there is no axis.
    """

    def __init__(self, axes: Mapping[str, PreisachStage]) -> None:
        if not axes:
            raise UsageError("stage: it has no axis; name at least one")
        self.axes = dict(axes)

    @classmethod
    def random(cls, names: Sequence[str], seed: int, noise_rms: float | None = None) -> "Stage":
        """Draw a plausible stage.

        Parameters
        ----------
        names : sequence of str
            The axes.
        seed : int
            The first axis is that of ``StageParameters.random(seed)``; the others differ from it.
        noise_rms : float, metres, optional
            Sensor noise of every axis in place of the default.

        Returns
        -------
        Stage
            At rest.

        Raises
        ------
        UsageError
            If the names are not unique.
        """
        if len(set(names)) != len(names):
            raise UsageError(f"stage: axes {', '.join(names)} are not unique; give each axis its own name")
        axes = {}
        for index, name in enumerate(names):
            parameters = StageParameters.random(seed + 1000 * index)
            if noise_rms is not None:
                parameters = replace(parameters, noise_rms=noise_rms)
            axes[name] = PreisachStage(parameters, seed + 1000 * index)
        return cls(axes)

    @property
    def voltage_range(self) -> tuple[float, float]:
        """Lowest and highest voltage that every axis accepts, volts."""
        parameters = [axis.parameters for axis in self.axes.values()]
        return max(p.threshold_min for p in parameters), min(p.threshold_max for p in parameters)

    def step(self, t: float, voltages: Sequence[float]) -> list[float]:
        """Apply one voltage to each axis.

        Parameters
        ----------
        t : float, seconds
            When.
        voltages : sequence of float, length of `axes`, volts
            In the order of `axes`.

        Returns
        -------
        list of float, length of `axes`, metres
            The displacements, without sensor errors.
        """
        return [axis.step(t, v) for axis, v in zip(self.axes.values(), voltages, strict=True)]

    def measure(self, displacements: Sequence[float]) -> list[float]:
        """Read every sensor: displacements in, readings out, both in metres and in the order of `axes`."""
        return [axis.measure(y) for axis, y in zip(self.axes.values(), displacements, strict=True)]
