"""Compiled evaluation of whole paths through effects with a state that changes from sample to sample."""
# `inverse_path` does at each sample what `slpi_ros.model.streaming.StreamingInverse.move` does, with the same rounding:
# changes of one are changes of both. The machine code is kept until this file changes, not those that it calls.

from math import expm1
from typing import NamedTuple

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.effects import filters
from slpi_ros.effects.filters import DAMPING, WIDEST
from slpi_ros.hysteresis import compiled as engine
from slpi_ros.hysteresis.compiled import compiled
from slpi_ros.hysteresis.shapes import Branches


class Laws(NamedTuple):
    """Parameters of the effects of an axis, each as its method `laws` returns them; without the effect: empty or 0."""

    lag: float = 0.0  # s
    slew: float = np.inf  # V/s, of the amplifier
    rate: FloatArray = np.empty(0)  # (0,) or (3,): threshold (V), onset rate (V/s), reversible gain (m/V)
    relaxations: FloatArray = np.empty((2, 0))  # (2, K): time constants (s) and gains of the creep
    rest_of_creep: float = np.inf  # m, its origin; inf: the displacement at the start
    contact: FloatArray = np.array([np.inf, 1.0])  # (2,): position (m) and gain beyond it
    modes: FloatArray = np.empty((0, 4))  # (M, 4): 0, angular frequency (rad/s), damping, gain
    rest: float = 1.0  # share of the motion beside the modes
    factors: FloatArray = np.empty((0, 8))  # (F, 8), of the inverse of the resonance, `Exact.law`, `Unringing.law`
    heating: FloatArray = np.empty(0)  # (0,) or (4,): gain (s^2/V^2), time constant (s), origin (m), most (V^2/s^2)
    gain: FloatArray = np.array([0.0, 1.0])  # (2,): origin (m) and factor of the sensitivity


@compiled
def relaxed(moved: FloatArray, gains: FloatArray, holds: FloatArray) -> FloatArray:
    """Return the sum of first-order relaxations (m, (N,)) with gains (K,) and `holds` (K, 3) as `filters.Hold`."""
    crept, before, states = np.empty_like(moved), 0.0, np.zeros(gains.size)
    for k in range(moved.size):
        total = 0.0
        for i in range(gains.size):
            states[i] = holds[i, 0] * moved[k] + holds[i, 1] * before + holds[i, 2] * states[i]
            total += gains[i] * states[i]
        crept[k], before = total, moved[k]
    return crept


@compiled
def heated(dt: FloatArray, v: FloatArray, time_constant: float, first: float, most: float) -> FloatArray:
    """Return the mean square rates (V^2/s^2, (N,)) of voltages (V, (N,)), as `StreamingSelfHeating.forward`."""
    before, now, last = np.empty_like(v), min(first, most), v[0]
    for k in range(v.size):
        before[k] = now
        if dt[k] > 0.0:
            moved, rate = -expm1(-dt[k] / time_constant), (v[k] - last) / dt[k]
            before[k] = now * (1.0 - moved)
            now = min(before[k] + moved * rate * rate, most)
        last = v[k]
    return before


# Of any damping.
hold, mode_poles = compiled(filters.hold), compiled(filters.mode_poles)
mode_transition = compiled(filters.mode_transition)


# Functions that are called at each sample take few arrays: counting references to each costs as much as the arithmetic.
# Columns of the array of a creep: time constant, gain, coefficients of `Hold`, gain times the last of them, and state;
# its last row holds origin, last input, step, and the sums of the gains times the first and the second coefficient.
TAU, GAIN, NOW, BEFORE, KEPT, SHARE, STATE = range(7)
ORIGIN, INPUT, STEP, SUM_NOW, SUM_BEFORE = range(5)
# Columns of an array of modes: angular frequency, damping, then as given, and from `MOVED` on input, position and
# velocity, step and transition matrix; of a factor that looks back, spacing and taps, first and end of its inputs.
OMEGA, DAMPED, MOVED, MATRIX, WIDTH = 1, 2, 8, 11, 18
# Places in the array of a self-heating: as given, then step, what fades in it, mean square rate, and last voltage.
HEAT, FADES, ZERO, MOST, SPAN, FADED, RATE, VOLTAGE = range(8)


@compiled
def creep_over(dt: float, creep: FloatArray) -> None:
    """Set the coefficients for a step `dt` (s)."""
    last = creep.shape[0] - 1
    creep[last, STEP], creep[last, SUM_NOW], creep[last, SUM_BEFORE] = dt, 0.0, 0.0
    for k in range(last):
        gain, one = creep[k, GAIN], hold(dt, creep[k, TAU])
        creep[k, NOW], creep[k, BEFORE], creep[k, KEPT] = one.now, one.before, one.kept
        creep[k, SHARE] = gain * one.kept
        creep[last, SUM_NOW] += gain * one.now
        creep[last, SUM_BEFORE] += gain * one.before


@compiled
def creep_inverse(dt: float, wanted: float, creep: FloatArray) -> float:
    """Return the displacement before creep (m), as `StreamingCreep.inverse`."""
    last = creep.shape[0] - 1
    if dt != creep[last, STEP]:
        creep_over(dt, creep)
    crept = creep[last, SUM_BEFORE] * creep[last, INPUT]
    for k in range(last):
        crept += creep[k, SHARE] * creep[k, STATE]
    origin = creep[last, ORIGIN]
    return float(origin + (wanted - origin - crept) / (1.0 + creep[last, SUM_NOW]))


@compiled
def creep_forward(dt: float, x: float, creep: FloatArray) -> float:
    """Return the displacement with creep (m), as `StreamingCreep.forward`."""
    last = creep.shape[0] - 1
    if dt != creep[last, STEP]:
        creep_over(dt, creep)
    moved, before = x - creep[last, ORIGIN], creep[last, INPUT]
    crept = creep[last, SUM_BEFORE] * before
    for k in range(last):
        crept += creep[k, SHARE] * creep[k, STATE]
    crept += creep[last, SUM_NOW] * moved
    for k in range(last):
        creep[k, STATE] = creep[k, NOW] * moved + creep[k, BEFORE] * before + creep[k, KEPT] * creep[k, STATE]
    creep[last, INPUT] = moved
    return float(x + crept)


@compiled
def contact_forward(x: float, contact: FloatArray) -> float:
    """Return the displacement with a contact (m), as `StreamingContact.forward`."""
    return float(contact[0] + contact[1] * (x - contact[0])) if x > contact[0] else x


@compiled
def contact_inverse(wanted: float, contact: FloatArray) -> float:
    """Return the displacement without a contact (m), as `StreamingContact.inverse`."""
    return float(contact[0] + (wanted - contact[0]) / contact[1]) if wanted > contact[0] else wanted


@compiled
def heat_left(dt: float, heating: FloatArray) -> float:
    """Return what is left of the mean square rate (V^2/s^2), as in `StreamingSelfHeating`."""
    if dt != heating[SPAN]:
        heating[SPAN], heating[FADED] = dt, -expm1(-dt / heating[FADES])
    return float(heating[RATE] * (1.0 - heating[FADED]))


@compiled
def heating_inverse(dt: float, wanted: float, heating: FloatArray) -> float:
    """Return the displacement of the cold stage (m), as `StreamingSelfHeating.inverse`."""
    return float(heating[ZERO] + (wanted - heating[ZERO]) / (1.0 + heating[HEAT] * heat_left(dt, heating)))


@compiled
def heating_forward(dt: float, x: float, v: float, heating: FloatArray) -> float:
    """Return the displacement (m) for a voltage `v` (V) at the piezo, as `StreamingSelfHeating.forward`."""
    left = heat_left(dt, heating)
    heating[RATE] = left
    if dt > 0.0:
        rate = (v - heating[VOLTAGE]) / dt
        heating[RATE] = min(left + heating[FADED] * rate * rate, heating[MOST])
    heating[VOLTAGE] = v
    return float(heating[ZERO] + (1.0 + heating[HEAT] * left) * (x - heating[ZERO]))


@compiled
def mode_after(dt: float, x: float, modes: FloatArray, k: int) -> tuple[float, float, float]:
    """Return the state of a mode after `dt` (s), as `StreamingMode.after`."""
    before, position, velocity = modes[k, MOVED], modes[k, MOVED + 1], modes[k, MOVED + 2]
    if dt <= 0.0:
        return x, position, velocity
    omega, damping = modes[k, OMEGA], modes[k, DAMPED]
    if dt != modes[k, MATRIX]:
        m11, m12, m21, m22 = mode_transition(omega, damping, dt)
        modes[k, MATRIX], modes[k, MATRIX + 1], modes[k, MATRIX + 2] = dt, m11, m12
        modes[k, MATRIX + 3], modes[k, MATRIX + 4] = m21, m22
    slope = (x - before) / dt
    behind = 2 * damping / omega * slope
    position, velocity = position - before + behind, velocity - slope
    return (
        x,
        x - behind + modes[k, MATRIX + 1] * position + modes[k, MATRIX + 2] * velocity,
        slope + modes[k, MATRIX + 3] * position + modes[k, MATRIX + 4] * velocity,
    )


@compiled
def unringing(dt: float, wanted: float, factors: FloatArray, f: int, gaps: FloatArray, values: FloatArray) -> float:
    """Return the input (m) of a mode, as `Unringing.inverse`."""
    first, last, taps = int(factors[f, MATRIX + 5]), int(factors[f, MATRIX + 6]), MATRIX + 1
    spacing = max(dt, factors[f, 4])
    if spacing != factors[f, MATRIX]:
        a, b, c = 1.0, 0.0, 0.0
        if spacing * factors[f, OMEGA] < WIDEST:
            total, product = mode_poles(factors[f, OMEGA], factors[f, DAMPED], spacing)
            a, b, c = 1.0 / (1 - total + product), -total / (1 - total + product), product / (1 - total + product)
        delay = factors[f, 3] / spacing + b + 2 * c
        factors[f, MATRIX], factors[f, taps] = spacing, a * (1 + delay)
        factors[f, taps + 1], factors[f, taps + 2] = b * (1 + delay) - a * delay, c * (1 + delay) - b * delay
        factors[f, taps + 3] = -c * delay
    later, earlier, at, value = 0.0, dt, spacing, wanted
    needed, k = factors[f, taps] * wanted, 1
    for place in range(last - 1, first - 1, -1):
        before = values[f, place]
        while at <= earlier:
            share = (earlier - at) / (earlier - later) if earlier > later else 0.0
            needed += factors[f, taps + k] * (before + (value - before) * share)
            k += 1
            if k == 4:
                return float(needed)
            at += spacing
        later, value = earlier, before
        earlier += gaps[f, place]
    left = 0.0
    for tap in range(k, 4):
        left += factors[f, taps + tap]
    return float(needed + left * value)


@compiled
def resonance_inverse(
    dt: float, wanted: float, factors: FloatArray, inputs: FloatArray, gaps: FloatArray, values: FloatArray
) -> float:
    """Return the input (m) of the modes, as `StreamingResonance.inverse`."""
    for f in range(factors.shape[0]):
        inputs[f] = wanted
        if factors[f, 0] > 0.0:
            wanted = unringing(dt, wanted, factors, f, gaps, values)
        elif dt >= factors[f, 7]:
            wanted = wanted + (wanted - factors[f, MOVED]) * (factors[f, 6] / dt)
        else:
            _, position, velocity = mode_after(dt, wanted, factors, f)
            wanted = factors[f, 3] * wanted + factors[f, 4] * position + factors[f, 5] * velocity
    return wanted


@compiled
def factors_forward(dt: float, factors: FloatArray, inputs: FloatArray, gaps: FloatArray, values: FloatArray) -> None:
    """Advance the factors of the inverse of a resonance, as `move` of each."""
    for f in range(factors.shape[0]):
        if not factors[f, 0] > 0.0:
            x, position, velocity = mode_after(dt, inputs[f], factors, f)
            factors[f, MOVED], factors[f, MOVED + 1], factors[f, MOVED + 2] = x, position, velocity
            continue
        first, last = int(factors[f, MATRIX + 5]), int(factors[f, MATRIX + 6])
        if dt <= 0.0:
            last -= 1
        else:
            gaps[f, last] = dt
        values[f, last] = inputs[f]
        oldest, age = 4 * max(factors[f, 4], dt), 0.0
        for place in range(last, first, -1):
            age += gaps[f, place]
            if age >= oldest:
                first = place - 1
                break
        factors[f, MATRIX + 5], factors[f, MATRIX + 6] = first, last + 1


@compiled
def modes_forward(dt: float, x: float, rest: float, modes: FloatArray) -> float:
    """Return the position of the stage (m) for the input of its modes (m), as `StreamingResonance.forward`."""
    y = rest * x
    for k in range(modes.shape[0]):
        _, position, velocity = mode_after(dt, x, modes, k)
        modes[k, MOVED], modes[k, MOVED + 1], modes[k, MOVED + 2] = x, position, velocity
        y += modes[k, 3] * position
    return y


@compiled
def lag_forward(dt: float, x: float, time_constant: float, lag: FloatArray) -> float:
    """Return the lagged voltage (V), as `StreamingLag.forward`; `lag`: command and lagged voltage."""
    one = hold(dt, time_constant)
    output: float = lag[1] + (one.now * (x - lag[1]) + one.before * (lag[0] - lag[1]))
    lag[0], lag[1] = x, output
    return output


@compiled
def slew_forward(dt: float, x: float, rate: float, output: float) -> float:
    """Return the voltage at the piezo (V), as `StreamingSlew.forward`; `output` is the last one."""
    most, way = rate * dt, x - output
    return x if -most <= way <= most else output + (most if way > 0.0 else -most)


@compiled
def inverse_path(
    dt: FloatArray,
    wanted: FloatArray,
    lower: float,
    upper: float,
    longest: float,
    rounding: tuple[float, float],
    far: float,
    laws: Laws,
    out: FloatArray,
    held: Mask,
    point: FloatArray,
    turns: FloatArray,
    direction: float,
    depth: int,
    rest: FloatArray,
    symmetric_rest: bool,
    first: FloatArray,
    branches: Branches,
) -> int:
    """Compensate the effects and the hysteresis of an axis along a path, from equilibrium at the present point.

    Return the number of samples evaluated, less than N if the model cannot reach the next one. Outputs, shape (N,): the
    commands `out` (V), and whether each is `held` at the limit beyond which the desired displacement lies.

    `dt` (s), shape (N,), is the time from the sample before; a step counts as at most `longest` (s), and before it the
    voltage is held. `wanted` (m), shape (N,), is the desired displacement of the axis without cross-coupling, and
    `lower`, `upper` (V) limit the command. `rounding` holds differences of displacements (m), and relative ones of
    voltages, up to which they are equal, and `far` (m) is the largest distance of a displacement of the hysteresis from
    rest. `turns`, shape (2, depth + 4 N + 4), V and m, and all arguments from `point` on are as in
    `slpi_ros.hysteresis.compiled.through`.
    """
    shape = (rest, symmetric_rest, first, branches)
    at = np.array([int(direction), depth, 0, 0])
    ends, knots = np.empty((2, 2)), engine.room(first, branches)
    has_rate, has_lag, has_slew = laws.rate.size > 0, laws.lag > 0.0, laws.slew < np.inf
    x, k, m, f = point[1], laws.relaxations.shape[1], laws.modes.shape[0], laws.factors.shape[0]
    creep = np.zeros((k + 1, 7))
    creep[:k, TAU], creep[:k, GAIN] = laws.relaxations[0], laws.relaxations[1]
    creep[k, ORIGIN], creep[k, STEP] = x, -1.0
    if laws.rest_of_creep < np.inf:
        creep[k, ORIGIN], creep[k, INPUT] = laws.rest_of_creep, x - laws.rest_of_creep
        creep[:k, STATE] = creep[k, INPUT]
        x += laws.relaxations[1].sum() * creep[k, INPUT]
    x, contact = contact_forward(x, laws.contact), laws.contact
    modes, factors, rest_share = np.zeros((m, WIDTH)), np.zeros((f, WIDTH)), laws.rest
    modes[:, :4], factors[:, :8] = laws.modes, laws.factors
    modes[:, MOVED : MOVED + 2] = factors[:, MOVED : MOVED + 2] = x
    factors[:, MATRIX + 6] = 1.0
    # Inputs of the factors, now and before.
    inputs, gaps, values = np.full(f, x), np.full((f, 2 * dt.size + 4), np.inf), np.empty((f, 2 * dt.size + 4))
    values[:, 0] = x
    has_heat, heating = laws.heating.size > 0, np.zeros(8)
    if has_heat:
        heating[:SPAN], heating[VOLTAGE] = laws.heating, point[0]
    origin, factor = laws.gain[0], laws.gain[1]
    lag, command, beside, slewed = np.array([point[0], point[0]]), point[0], 0.0, point[0]
    # As `StreamingRateDependence`: applied voltage, last three ``w``, last desired displacement.
    rate = np.array([point[0], 0.0, 0.0, 0.0, np.nan])
    for n in range(dt.size):
        counted = min(dt[n], longest)
        if n == 0 or dt[n] > longest:
            # At the start, and during a pause, the voltage is held.
            pause, axis = dt[n] - counted, point[1] + beside
            if n:
                reached = lag_forward(pause, command, laws.lag, lag) if has_lag else command
                slewed = slew_forward(pause, reached, laws.slew, slewed) if has_slew else slewed
            if k:
                axis = creep_forward(pause, axis, creep)
            if m:
                axis = contact_forward(axis, contact)
                axis = modes_forward(pause, axis, rest_share, modes)
                resonance_inverse(pause, axis, factors, inputs, gaps, values)
                factors_forward(pause, factors, inputs, gaps, values)
            if has_heat:
                heating_forward(pause, axis, heating[VOLTAGE], heating)
        h = origin + (wanted[n] - origin) / factor
        if has_heat:
            h = heating_inverse(counted, h, heating)
        if m:
            h = resonance_inverse(counted, h, factors, inputs, gaps, values)
        h = contact_inverse(h, contact)
        if k:
            h = creep_inverse(counted, h, creep)
        if not abs(h - rest[1]) < far:
            return n
        v_0, y_0, s_0, depth_0, rate_0 = point[0], point[1], at[0], at[1], rate[0]
        at[3] = 0
        if has_rate:
            done, turned, deep = engine.through_law(
                dt[n], h, laws.rate, lower, upper, rate, float(at[0]), point, turns, at[1], *shape
            )
            at[0], at[1], at[2], at[3] = int(turned), deep, 0, 1
            if not done:
                return n
            v, beside = rate[0], laws.rate[2] * (rate[0] - point[0])
        else:
            straight = engine.along(h, 1, lower, upper, point, at, ends, knots)
            if not straight and not engine.moved(h, 1, lower, upper, point, turns, at, ends, knots, *shape):
                return n
            v = point[0]
        missing = h - (point[1] + beside)
        if not abs(missing) > rounding[0]:
            missing = 0.0
        if has_lag or has_slew:
            inside, goal = v, v
            if has_lag and counted > 0.0:
                one = hold(counted, laws.lag)
                shift = DAMPING * one.before
                goal = v + (one.kept * (v - lag[1]) + (one.before - shift) * (v - lag[0])) / (one.now + shift)
            v = min(max(goal, lower), upper)
            if missing == 0.0 and abs(goal - v) > rounding[1] * (1.0 + abs(goal)):
                missing = goal - v
            reached = lag_forward(counted, v, laws.lag, lag) if has_lag else v
            if has_slew:
                reached = slewed = slew_forward(counted, reached, laws.slew, slewed)
            if reached != inside:
                point[0], point[1], at[0], at[1] = v_0, y_0, s_0, depth_0
                if at[3]:
                    at[2] = 0
                if has_rate:
                    applied, u = reached, v_0
                    scale, way = laws.rate[1] * dt[n], reached - v_0
                    if scale > 0.0:
                        if way != 0.0:
                            rate[1] = engine.solved(scale, laws.rate[0], abs(way), rate[1])
                            u = engine.followed(laws.rate[0], reached, v_0, rate[1])
                    else:
                        u = v_0 + (reached - rate_0)
                    rate[0], rate[4] = applied, np.nan
                    reached = u
                straight = engine.along(reached, 0, lower, upper, point, at, ends, knots)
                if not straight and not engine.moved(reached, 0, lower, upper, point, turns, at, ends, knots, *shape):
                    return n
                if has_rate:
                    beside = laws.rate[2] * (rate[0] - point[0])
        out[n] = command = v
        axis = point[1] + beside
        if k:
            axis = creep_forward(counted, axis, creep)
        axis = contact_forward(axis, contact)
        if m:
            axis = modes_forward(counted, axis, rest_share, modes)
            factors_forward(counted, factors, inputs, gaps, values)
        if has_heat:
            axis = heating_forward(counted, axis, rate[0] if has_rate else point[0], heating)
        short = wanted[n] - (origin + factor * (axis - origin))
        if min(missing, short) > 0.0:
            held[n] = v >= upper - rounding[1] * (1.0 + abs(upper))
        else:
            held[n] = max(missing, short) < 0.0 and v <= lower + rounding[1] * (1.0 + abs(lower))
    return dt.size
