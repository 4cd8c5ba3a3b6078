"""Paths of axes whose effects depend on time: compensated point by point, all axes together."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.coupling import Coupling
from slpi_ros.errors import SlpiError
from slpi_ros.model.stage_model import AxisModel
from slpi_ros.model.stage_stream import StageStream
from slpi_ros.model.stream import LONGEST_STEP, AxisStream

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]


def follow_together(
    streams: Mapping[str, AxisStream],
    models: Mapping[str, AxisModel],
    paths: Mapping[str, FloatArray],
    elapsed: Mapping[str, FloatArray],
) -> dict[str, tuple[FloatArray, Mask, Mask]]:
    """Move axes through displacements, each as `AxisStream.move` does; a delay is undone by preview.

    Parameters
    ----------
    streams : mapping of axis name to AxisStream
        All axes of the stage; those that have no path stay.
    models : mapping of axis name to AxisModel
        Of all axes.
    paths : mapping of axis name to ndarray, shape (N,), metres
    elapsed : mapping of axis name to ndarray, shape (N,), seconds
        Since the point before.

    Returns
    -------
    dict of axis name to (ndarray, ndarray of bool, ndarray of bool), shape (N,) each
        Voltages (V), where the axis waits at a voltage limit, and where it is still on its way.

    Raises
    ------
    SlpiError
        It names the axis.
    """
    coupling = Coupling({name: models[name].chain.gains for name in streams})
    stage = StageStream(streams, coupling, {name: models[name].start.displacement for name in streams})
    ahead = {name: _previewed(models[name].chain.delay, path, elapsed[name]).tolist() for name, path in paths.items()}
    steps = {name: each.tolist() for name, each in elapsed.items()}
    answers = {
        name: (np.empty(path.size), np.zeros(path.size, bool), np.zeros(path.size, bool))
        for name, path in paths.items()
    }
    for k in range(len(next(iter(ahead.values())))):
        stage.decouple({name: path[k] for name, path in ahead.items()})
        for name, (v, held, slewed) in answers.items():
            stream = streams[name]
            try:
                v[k] = _move(stream, steps[name][k], ahead[name][k])
            except SlpiError as error:
                raise type(error)(f"axis '{name}': {error}") from None
            held[k] = stream.held
            slewed[k] = stream.missed and not held[k]
    return answers


def drive_through(stream: AxisStream, voltages: FloatArray, elapsed: FloatArray) -> None:
    """Move an axis through voltages, shape (N,), volts, each `elapsed` (s) after the one before."""
    for voltage, seconds in zip(voltages.tolist(), elapsed.tolist(), strict=True):
        dt = min(seconds, LONGEST_STEP)
        stream.wait(seconds - dt)
        stream.drive(voltage, dt)


def _move(stream: AxisStream, elapsed: float, wish: float) -> float:
    dt = stream.pace.counted(elapsed)
    if elapsed > dt:
        stream.wait(elapsed - dt)
    return stream.move(dt, wish)


def _previewed(delay: float, path: FloatArray, elapsed: FloatArray) -> FloatArray:
    """Return the path, shape (N,), metres, as it is a delay (s) later."""
    t = np.cumsum(elapsed)
    return np.interp(t + delay, t, path) if delay else path
