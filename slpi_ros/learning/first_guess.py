"""First guess of the gains of a path that repeats: what the identified dynamics say, and how sure they are."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Effect
from slpi_ros.errors import SlpiError
from slpi_ros.learning.harmonics import ComplexArray
from slpi_ros.learning.modes import Mode
from slpi_ros.model.axis_model import AxisModel

# Relative standard deviation of a gain at low frequencies. It grows with the square of the frequency, by 1 at that of a
# mode that no effect describes: this (Hz), or an octave above the lowest identified mode, which another below would
# have been identified with. Beyond, it is at most the rms gain of a mode of 2 % damping that may be anywhere within a
# decade: sqrt(pi / (4 x 0.02) / log(10)).
DOUBT, DOUBT_HZ, OCTAVE, MOST_DOUBT = 0.05, 150.0, 2.0, 4.0
# Standard errors of an effect's parameter by which it may be wrong, and the least relative one.
STANDARD_ERRORS, LEAST_RELATIVE = 2.0, 0.005
# Samples of the test signal, its repetitions until it has settled, and its amplitude as a share of the stroke.
SAMPLES, REPEATED, AMPLITUDE = 2048, 3, 1e-3
# Frequency (Hz) from which the test signal falls with the square of the frequency, as paths do: the inverse of a mode
# makes voltages of high frequencies so large that hysteresis answers to them at all others.
FALLING_HZ = 100.0
# Largest frequency (rad/sample) of a mode that samples of the path show.
HIGHEST_ANGLE = 2.8


def first_guess(axis: AxisModel, dt: float, frequency: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Return the gain from a change of the desired path to that of the displacement, and its variance.

    The model's own answer to the voltages of its inverse: 1 but for dynamics that the inverse leaves. The variance is
    that of the answers of models whose effects are wrong by their standard errors, plus `DOUBT`.

    Parameters
    ----------
    axis : AxisModel
    dt : float, seconds
        Sampling interval of the path.
    frequency : ndarray, shape (K,), hertz

    Returns
    -------
    gain : ndarray of complex, shape (K,), metres per metre
    variance : ndarray, shape (K,)
    """
    plain = np.ones(frequency.size, dtype=np.complex128)
    unknown = max(DOUBT_HZ, OCTAVE * min((hertz for hertz, _ in ringing(axis)), default=0.0))
    variance = np.minimum(DOUBT + (frequency / unknown) ** 2, MOST_DOUBT) ** 2
    stage = axis.stage_only
    if not stage.effects:
        return plain, variance
    grid, tested = np.fft.rfftfreq(SAMPLES, dt), _Test(stage, dt)
    try:
        own = tested.answer(stage)
        gain = np.interp(frequency, grid, own.real) + 1j * np.interp(frequency, grid, own.imag)
        for other in _others(stage):
            variance += np.interp(frequency, grid, np.abs(tested.answer(other) - own) ** 2)
    except SlpiError:
        # A model that does not answer a small signal tells nothing.
        return plain, variance
    return gain, variance


def ringing(axis: AxisModel) -> list[tuple[float, float]]:
    """Return frequency (Hz) of each identified mode, and the time (s) in which it falls by the factor e."""
    modes = [mode for effect in axis.stage_only.effects for mode in getattr(effect, "modes", ())]
    return [(mode.frequency, 1.0 / mode.decay) for mode in modes]


def amplification(axis: AxisModel, frequency: FloatArray) -> FloatArray:
    """Return how much identified modes amplify what is left of the hysteresis, (K,), at least 1; `frequency` (Hz)."""
    found: ComplexArray = np.ones(frequency.size, dtype=np.complex128)
    for effect in axis.stage_only.effects:
        for mode in getattr(effect, "modes", ()):
            found += mode.gain * (mode.response(frequency) - 1.0)
    return np.maximum(np.abs(found), 1.0)


def known_modes(axis: AxisModel, dt: float) -> list[Mode]:
    """Return the modes that ring behind the inverse, sampled at `dt` (s): identified ones, and those of the inverse."""
    found: list[Mode] = []
    for effect in axis.stage_only.effects:
        found += [Mode.of(mode.frequency, mode.damping, dt) for mode in getattr(effect, "modes", ())]
        own = effect.inverse_modes() if hasattr(effect, "inverse_modes") else ()
        found += [Mode.of(zero.frequency, zero.damping, dt, exact=True) for zero in own]
    return [mode for mode in found if 0.0 < mode.angle < HIGHEST_ANGLE]


class _Test:
    """A small periodic signal about the centre of the range, and the voltages of the inverse for it."""

    def __init__(self, stage: AxisModel, dt: float) -> None:
        low, high = stage.displacement_range
        phases = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, SAMPLES // 2 + 1)
        phases[[0, -1]] = 0.0
        size = 1.0 / (1.0 + (np.fft.rfftfreq(SAMPLES, dt) / FALLING_HZ) ** 2)
        size[0] = 0.0
        signal = np.fft.irfft(np.exp(1j * phases) * size, SAMPLES)
        signal *= AMPLITUDE * (high - low) / np.abs(signal).max()
        self._signal = np.fft.rfft(signal)
        self._signal[0] = 1.0
        self._t: FloatArray = np.arange((REPEATED + 1) * SAMPLES, dtype=np.float64) * dt
        centre = np.full(self._t.size, 0.5 * (low + high))
        lead = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, SAMPLES // 2))
        start = stage.start.displacement
        centre[: lead.size] = start + (centre[-1] - start) * lead
        tested = centre + np.concatenate([np.zeros(SAMPLES), np.tile(signal, REPEATED)])
        self._v = [stage.stream(start_memory="start").run(self._t, path)[0] for path in (centre, tested)]

    def answer(self, stage: AxisModel) -> ComplexArray:
        """Return the gain of the test signal's harmonics, (SAMPLES // 2 + 1,), through the inverse and `stage`."""
        rest, moved = (stage.uncoupled_displacement(self._t, v)[-SAMPLES:] for v in self._v)
        answer = np.fft.rfft(moved - rest) / self._signal
        answer[0] = 1.0
        return np.asarray(answer)


def _others(stage: AxisModel) -> Iterator[AxisModel]:
    """Yield the stage with one parameter of its linear dynamics wrong at a time."""
    for place, effect in enumerate(stage.effects):
        for changed in _changed(effect):
            yield replace(stage, effects=(*stage.effects[:place], changed, *stage.effects[place + 1 :]))


def _changed(effect: Effect) -> Iterator[Effect]:
    if not (effect.dynamic or hasattr(effect, "modes")):
        return
    leaves = effect.free_leaves()
    for at, leaf in enumerate(leaves):
        wrong = max(STANDARD_ERRORS * effect.uncertainty.get(leaf.place, 0.0), LEAST_RELATIVE * abs(leaf.value))
        if wrong > 0.0:
            numbers = [each.value + (wrong if k == at else 0.0) for k, each in enumerate(leaves)]
            try:
                yield effect.with_free(numbers)
            except SlpiError:
                continue
