import json
from dataclasses import replace

import control
import numpy as np
import pytest
from effects.cases import ABOUT_MOTION, BY_NAME, EVERY, creeps, effects_and_records, numbers, records, sensors
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.signal import lsim

from slpi_ros.effects.base import Effect, EffectContext
from slpi_ros.effects.chain import Chain
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.hum import Hum, Line
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.registry import EFFECTS, from_document, in_order, to_document
from slpi_ros.effects.resonance import Resonance, zeros
from slpi_ros.effects.steps import Steps
from slpi_ros.errors import SlpiError
from slpi_ros.io.schemas import load_schema

EXACT = ("rate_dependence", "creep", "contact", "gain_drift", "cross_coupling", "thermal_drift", "steps")
EXACT = (*EXACT, "self_heating", "surroundings", "sensor_periodic", "hum")
INVERTED = ("lag", "creep", "contact", "resonance", "sensor_periodic")
FOLLOWED = (*INVERTED, "slew")


def test_registry_schemas_and_strategies_know_the_same_effects():
    model, diagnosis = (load_schema(name)["$defs"]["effect"] for name in ("model", "diagnosis"))
    # The model's schema lists them in the order of the signal chain.
    assert list(EFFECTS) == model["properties"]["name"]["enum"]
    assert set(EFFECTS) == set(diagnosis["enum"]) == set(BY_NAME)
    for name, kind in EFFECTS.items():
        assert kind.name == name


@given(EVERY)
def test_every_effect_has_its_side_and_acts_on_one_signal(effect):
    signals = dict.fromkeys(("delay", "lag", "slew", "saturation"), "voltage") | {"rate_dependence": "hysteresis"}
    assert effect.acts_on == signals.get(effect.name, "displacement")
    others = {"sensor_periodic": "sensor", "hum": "record", "thermal_drift": "record", "steps": "record"}
    others["clock"] = "record"
    assert effect.side == others.get(effect.name, "stage")
    # No inverse for the stage holds what is not of the stage.
    chain = Chain.of((effect,))
    assert (effect in chain.measured) == (effect.side != "stage")
    assert (effect in (*chain.before, chain.around, *chain.own, *chain.shared)) == (effect.side == "stage")


@given(effects_and_records(EXACT))
def test_exact_inverses(drawn):
    effect, record = drawn
    back = effect.invert(effect.apply(record.signal, record.around), record.around)
    np.testing.assert_allclose(back, record.signal, rtol=0, atol=1e-9 * record.span)
    there = effect.apply(effect.invert(record.signal, record.around), record.around)
    np.testing.assert_allclose(there, record.signal, rtol=0, atol=1e-9 * record.span)


@given(effects_and_records(("lag", "resonance")))
def test_inverses_that_are_damped(drawn):
    """On smooth paths, up to 3 Hz at 500 samples per second or more, they are good to a thousandth of the motion."""
    effect, record = drawn
    there = effect.apply(effect.invert(record.signal, record.around), record.around)
    slow = 0.0
    if isinstance(effect, Resonance):
        slow = sum((3 / mode.frequency) ** 2 for mode in effect.modes)
        # At a multiple of the sampling rate the corners of the sampled path itself excite the mode.
        cycles = np.array([mode.frequency * record.around.t[1] for mode in effect.modes])
        assume(np.all((cycles < 0.5) | (np.abs(cycles - np.round(cycles)) > 0.03)))
    np.testing.assert_allclose(there, record.signal, rtol=0, atol=(1e-3 + slow) * record.span)


@given(BY_NAME["delay"], records("voltage"))
def test_delay_is_undone_by_preview(effect, record):
    back = effect.invert(effect.apply(record.signal, record.around), record.around)
    t, shift = record.around.t, abs(effect.seconds)
    known = (t >= t[0] + shift) & (t <= t[-1] - shift)
    np.testing.assert_allclose(back[known], record.signal[known], rtol=0, atol=1e-3 * max(record.span, 1e-9))


@given(BY_NAME["saturation"], records("voltage"))
def test_saturation_is_a_limit(effect, record):
    clipped = effect.apply(record.signal, record.around)
    assert clipped.min() >= effect.lower
    assert clipped.max() <= effect.upper
    inside = (record.signal >= effect.lower) & (record.signal <= effect.upper)
    assert (clipped[inside] == record.signal[inside]).all()
    assert (effect.invert(clipped, record.around) == clipped).all()
    assert effect.passes == (effect.lower, effect.upper)
    assert effect.streaming() is None, "the limits of the command are those of the effect"


@given(BY_NAME["slew"], records("voltage"), st.none() | st.floats(0, 100))
def test_a_slew_limit_is_the_fastest_way_to_the_command(effect, record, start):
    around = replace(record.around, start=start)
    u, t, now = effect.apply(record.signal, around), around.t, record.signal[0] if start is None else start
    for k, step in enumerate(effect.rate * np.diff(t, prepend=t[0])):
        now = np.clip(record.signal[k], now - step, now + step)
        assert u[k] == pytest.approx(now, rel=1e-12, abs=1e-12)
    np.testing.assert_array_equal(effect.invert(u, around), u)


@given(BY_NAME["contact"], records("displacement"), numbers(-1e-6, 1e-6))
def test_a_contact_moves_with_the_zero(effect, record, by):
    moved = effect.shifted(by).apply(record.signal + by, record.around)
    np.testing.assert_allclose(moved, effect.apply(record.signal, record.around) + by, rtol=0, atol=1e-15)
    before = record.signal <= effect.position
    np.testing.assert_array_equal(effect.apply(record.signal, record.around)[before], record.signal[before])


@given(effects_and_records(ABOUT_MOTION), st.sampled_from(("apply", "invert")))
def test_at_rest_nothing_changes(drawn, verb):
    effect, record = drawn
    rest = np.full_like(record.signal, record.signal[0])
    around = replace(record.around, others={})
    np.testing.assert_allclose(getattr(effect, verb)(rest, around), rest, rtol=1e-12)


@given(effects_and_records(FOLLOWED))
def test_follower_does_what_apply_does(drawn):
    effect, record = drawn
    streaming, samples, steps = effect.streaming(), record.signal.tolist(), np.diff(record.around.t, prepend=0.0)
    streaming.start(samples[0])
    followed = [streaming.forward(dt, x) for dt, x in zip(steps.tolist(), samples, strict=True)]
    # Stamps are even to rounding only.
    expected = effect.apply(record.signal, record.around)
    np.testing.assert_allclose(followed, expected, rtol=0, atol=1e-8 * record.span)


@given(effects_and_records(INVERTED), st.data())
def test_follower_gives_what_is_wanted(drawn, data):
    """In uneven steps too; and asking moves nothing."""
    effect, record = drawn
    if effect.name in ("lag", "resonance"):
        modes = effect.modes if isinstance(effect, Resonance) else ()
        wanted, accuracy = record.signal, 2e-3 + sum(6 / mode.frequency for mode in modes)
    else:
        wanted, accuracy = record.signal, 1e-9
    jitter = np.random.default_rng(data.draw(st.integers(0, 10**6))).uniform(-0.4, 0.4, wanted.size)
    jitter[[0, -1]] = 0.0
    t = record.around.t + jitter * record.around.t[1]
    wanted = np.interp(t, record.around.t, wanted)
    streaming = effect.streaming()
    streaming.start(float(wanted[0]))
    got = []
    for dt, y in zip(np.diff(t, prepend=0.0).tolist(), wanted.tolist(), strict=True):
        before = streaming.snapshot()
        x = streaming.inverse(dt, y)
        assert streaming.inverse(dt, y) == x
        assert streaming.snapshot() == before
        got.append(streaming.forward(dt, x))
    np.testing.assert_allclose(got, wanted, rtol=0, atol=accuracy * record.span)


@given(effects_and_records(FOLLOWED), st.integers(1, 1000))
def test_a_snapshot_is_the_whole_state(drawn, at):
    effect, record = drawn
    one, other = effect.streaming(), effect.streaming()

    def step(streaming, dt, y):
        return streaming.forward(dt, streaming.inverse(dt, y))

    samples = list(zip(np.diff(record.around.t, prepend=0.0).tolist(), record.signal.tolist(), strict=True))
    for streaming in (one, other):
        streaming.start(samples[0][1])
    for sample in samples[:at]:
        step(one, *sample)
    # Through JSON, as a file keeps it.
    other.restore(_tuples(json.loads(json.dumps(one.snapshot()))))
    for sample in samples[at : at + 50]:
        assert step(other, *sample) == pytest.approx(step(one, *sample), rel=1e-9)


def _tuples(value):
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


@given(BY_NAME["lag"], records("voltage"))
def test_lag_against_lsim(lag, record):
    t, v = np.arange(record.signal.size) * record.around.t[1], record.signal - record.signal[0]
    _, expected, _ = lsim(([1.0], [lag.time_constant, 1.0]), v, t)
    result = lag.apply(v, EffectContext(t))
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-9 * record.span)


@given(BY_NAME["resonance"], records("displacement"))
def test_resonance_against_lsim(resonance, record):
    t, h = np.arange(record.signal.size) * record.around.t[1], record.signal - record.signal[0]
    expected = h.copy()
    for mode in resonance.modes:
        w = 2 * np.pi * mode.frequency
        expected += mode.gain * (lsim(([w * w], [1.0, 2 * mode.damping * w, w * w]), h, t)[1] - h)
    np.testing.assert_allclose(resonance.apply(h, EffectContext(t)), expected, rtol=0, atol=1e-6 * record.span)


@given(creeps(), records("displacement"))
def test_creep_against_python_control(creep, record):
    t, h = np.arange(record.signal.size) * record.around.t[1], record.signal - record.signal[0]
    taus, gains = creep.chain
    system = control.ss(np.diag(-1 / taus), (1 / taus)[:, None], gains[None], [[1.0]])
    expected = control.forced_response(system, t, h).outputs
    np.testing.assert_allclose(creep.apply(h, EffectContext(t)), expected, rtol=0, atol=1e-9 * record.span)


@pytest.mark.parametrize("name", ["lag", "creep", "resonance"])
@given(st.data())
def test_uneven_stamps_change_little(name, data):
    """The same motion sampled evenly and unevenly answers alike."""
    effect = data.draw(BY_NAME[name])
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    even = np.arange(3000) / 1000.0
    uneven = np.sort(np.concatenate([[0.0], rng.uniform(0, 3, 2999)]))

    def motion(t):
        return 1e-5 * np.sin(np.pi * t / 3) ** 4 * np.sin(2 * np.pi * 1.5 * t)

    one, other = (effect.apply(motion(t), EffectContext(t)) for t in (even, uneven))
    np.testing.assert_allclose(np.interp(even, uneven, other), one, rtol=0, atol=3e-7)


@given(sensors(), st.lists(st.floats(-1e-4, 1e-4), min_size=1, max_size=50))
def test_readings_of_a_sensor_rise(sensor, places):
    places = np.sort(np.array(places))
    readings = sensor.apply(places, EffectContext(np.arange(places.size)))
    assert (np.diff(readings) >= -1e-18).all()


# Modes, and the largest share of the error without compensation that is left on a smooth path.
RESONANCES = {
    "one": (((100.0, 0.01, 1.0),), 0.25),
    "nearly one": (((100.0, 0.01, 0.95),), 0.25),
    "a large part": (((100.0, 0.01, 0.85),), 3e-3),
    "a small part": (((100.0, 0.01, 0.05),), 1e-4),
    "two": (((100.0, 0.02, 0.7), (250.0, 0.01, 0.3)), 0.1),
    "two, a part": (((100.0, 0.02, 0.6), (250.0, 0.01, 0.2)), 1e-3),
    "two far apart": (((60.0, 0.02, 0.9), (1500.0, 0.02, 0.1)), 1e-2),
    "three": (((100.0, 0.05, 0.5), (150.0, 0.01, 0.3), (400.0, 0.02, 0.2)), 0.02),
    "three, a part": (((100.0, 0.05, 0.5), (150.0, 0.01, 0.2), (400.0, 0.02, 0.1)), 1e-3),
    "well damped": (((6.5, 0.45, 1.0),), 0.2),
    "two lags": (((6.5, 2.0, 1.0),), 0.15),
    "well damped, a part": (((6.5, 1.5, 0.4), (90.0, 0.02, 0.3)), 1e-3),
    "two alike": (((100.0, 0.01, 0.3), (100.0, 0.01, 0.3)), 1e-3),
}


def compensated(resonance: Resonance, t: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Return what a path becomes, compensated sample by sample."""
    streaming = resonance.streaming()
    streaming.start(float(path[0]))
    samples = zip(np.diff(t, prepend=0).tolist(), path.tolist(), strict=True)
    return np.array([streaming.forward(dt, streaming.inverse(dt, y)) for dt, y in samples])


@pytest.mark.parametrize("case", RESONANCES)
def test_modes_are_compensated(case):
    modes, share = RESONANCES[case]
    resonance, t = Resonance(tuple(Mode(*mode) for mode in modes)), np.arange(10_000) * 1e-4
    path, around = 1e-5 * np.sin(np.pi * t) ** 4 * np.sin(2 * np.pi * 5 * t), EffectContext(t)
    most = share * np.abs(resonance.apply(path, around) - path).max()
    assert np.abs(resonance.apply(resonance.invert(path, around), around) - path).max() < max(1e-6 * most, 1e-12 * 1e-5)
    assert np.abs(compensated(resonance, t, path) - path).max() < most


@pytest.mark.parametrize("case", RESONANCES)
def test_a_kick_ends_the_ringing(case):
    """After the wish has come to rest, so does the stage, within a fraction of a period of the slowest mode."""
    resonance, t = Resonance(tuple(Mode(*mode) for mode in RESONANCES[case][0])), np.arange(5000) * 1e-4
    wish = 1e-5 * np.clip(t / 0.05, 0, 1)
    rings = resonance.apply(wish, EffectContext(t)) - wish
    settled = t > 0.05 + 1.0 / min(mode.frequency for mode in resonance.modes)
    assert np.abs(compensated(resonance, t, wish) - wish)[settled].max() < 0.02 * np.abs(rings)[settled].max()


@given(BY_NAME["resonance"])
def test_zeros_make_up_the_resonance(resonance):
    """With the modes they have its response at any frequency; and all are stable."""
    found = zeros(resonance.modes, resonance.rest)
    assert len(found) == len(resonance.modes) - (resonance.rest == 0)
    s = 2j * np.pi * np.array([k * mode.frequency for mode in resonance.modes for k in (0.3, 0.9, 1.0, 1.1, 3.0)])

    def response(mode: Mode) -> np.ndarray:
        return mode.omega**2 / (s**2 + 2 * mode.damping * mode.omega * s + mode.omega**2)

    expected = resonance.rest + sum(mode.gain * response(mode) for mode in resonance.modes)
    product = np.prod([response(mode) for mode in resonance.modes], axis=0)
    for zero in found:
        assert zero.damping > 0
        product = product / response(zero)
    np.testing.assert_allclose(product, expected, rtol=1e-6)


def test_no_samples_one_sample_and_no_time():
    for effect in (Lag(0.01), Creep((0.1,), (0.1,)), Resonance((Mode(100.0, 0.1),))):
        for verb in (effect.apply, effect.invert):
            assert verb(np.empty(0), EffectContext(np.empty(0))).shape == (0,)
            assert verb(np.array([3.0]), EffectContext(np.array([7.0]))).tolist() == [3.0]
            assert np.isfinite(verb(np.array([3.0, 5.0, 4.0]), EffectContext(np.zeros(3)))).all()


@given(EVERY)
def test_parameters_survive_the_document(effect):
    spread = {next(iter(to_document(effect)["parameters"])): 0.5}
    for one in (effect, replace(effect, uncertainty=spread)):
        text = json.dumps(to_document(one), allow_nan=False)
        assert from_document(json.loads(text)) == one


def test_lists_are_joined():
    """Lines add up, modes share the motion, and what an axis has once is not joined."""
    around = EffectContext(np.arange(100) * 1e-3)
    one, other = Hum((Line(50.0, 1e-9, 0.1),)), Hum((Line(60.0, 2e-9, 0.2),))
    both = one.added(around) + other.added(around)
    np.testing.assert_allclose(one.joined(other).added(around), both, rtol=0, atol=1e-20)
    both = Resonance((Mode(100.0, 0.1, 0.9),)).joined(Resonance((Mode(300.0, 0.1, 0.9),)))
    assert [mode.gain for mode in both.modes] == [0.5, 0.5] and both.rest == 0.0
    twice = Steps((1.0, 2.0), (1e-9, 3e-9)).joined(Steps((1.5, 2.0), (5e-9, 1e-9)))
    assert twice == Steps((1.0, 1.5, 2.0), (1e-9, 5e-9, 4e-9))
    crowd = Hum((Line(50.0, 1e-9, 0.1),) * 100)
    assert crowd.joined(one) is None and Lag(0.1).joined(Lag(0.1)) is None


@given(st.lists(EVERY, unique_by=lambda effect: effect.name, max_size=11))
def test_effects_stand_in_the_order_of_the_chain(effects):
    ordered = in_order(effects)
    assert sorted(effect.name for effect in effects) == sorted(effect.name for effect in ordered)
    places = [list(EFFECTS).index(effect.name) for effect in ordered]
    assert places == sorted(places)


def test_what_has_a_default_may_be_left_out():
    assert from_document({"name": "rate_dependence", "parameters": RATE}) == RateDependence(**RATE)


def test_an_effect_comes_once():
    with pytest.raises(SlpiError, match="'lag'"):
        in_order([Lag(0.1), Lag(0.2)])


@given(EVERY)
def test_a_description_is_one_sentence(effect):
    assert len(effect.describe()) > 20
    assert "\n" not in effect.describe()


def test_a_stamp_ahead_of_its_voltage_is_called_early():
    t = np.arange(100) * 1e-3
    ahead = Delay(-0.02).apply(t, EffectContext(t))
    assert ahead[10] == pytest.approx(t[30]), "what the voltage is 20 ms later"
    assert "20 ms too early" in Delay(-0.02).describe()


NONSENSE = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers(-(10**400), 10**400) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@given(EVERY, st.data())
def test_hostile_documents_are_refused(effect, data):
    """With one thing wrong a document is refused in one line, or it is another valid effect."""
    document = to_document(effect)
    place = data.draw(st.sampled_from(("name", "parameters", "uncertainty", "one", "missing", "more")))
    parameters = document["parameters"]
    key = data.draw(st.sampled_from(sorted(parameters)))
    if place in document:
        document[place] = data.draw(NONSENSE)
    elif place == "one":
        parameters[key] = data.draw(NONSENSE)
    elif place == "missing":
        del parameters[key]
    else:
        parameters[data.draw(st.text())] = 1.0
    try:
        read: Effect = from_document(document)
    except SlpiError as error:
        assert "\n" not in str(error)
    else:
        assert from_document(to_document(read)) == read


RATE = {"threshold": 1.0, "onset_rate": 0.1}
MODE, LINE = {"frequency": 100.0, "damping": 0.1}, {"frequency": 50.0, "amplitude": 1e-9, "phase": 0.0}


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("lag", {"time_constant": -1.0}),
        ("lag", {"time_constant": 0.0}),
        ("lag", {"time_constant": float("nan")}),
        ("lag", {"time_constant": None}),
        ("lag", {"time_constant": True}),
        ("lag", {"time_constant": "0.1"}),
        ("lag", {}),
        ("delay", {"seconds": float("inf")}),
        ("slew", {"rate": 0.0}),
        ("slew", {"rate": None}),
        ("saturation", {"lower": 5.0, "upper": 5.0}),
        ("saturation", {"lower": float("nan"), "upper": None}),
        ("creep", {"time_constants": [], "gains": []}),
        ("creep", {"time_constants": [1.0], "gains": [0.1, 0.2]}),
        ("creep", {"time_constants": [1.0], "gains": [-1.0]}),
        ("creep", {"time_constants": 1.0, "gains": 0.1}),
        ("resonance", {"frequency": 100.0, "damping": 0.1}),
        ("resonance", {"modes": []}),
        ("resonance", {"modes": MODE}),
        ("resonance", {"modes": [100.0]}),
        ("resonance", {"modes": [MODE] * 11}),
        ("resonance", {"modes": [{"frequency": 100.0}]}),
        ("resonance", {"modes": [MODE | {"more": 1.0}]}),
        ("resonance", {"modes": [MODE | {"damping": 2.1}]}),
        ("resonance", {"modes": [MODE | {"frequency": 0.0}]}),
        ("resonance", {"modes": [MODE | {"frequency": float("nan")}]}),
        ("resonance", {"modes": [MODE | {"gain": -0.1}]}),
        ("resonance", {"modes": [MODE | {"gain": True}]}),
        ("resonance", {"modes": [MODE | {"gain": 0.6}] * 2}),
        ("cross_coupling", {"gains": {}}),
        ("cross_coupling", {"gains": {"y": 1.5}}),
        ("cross_coupling", {"gains": [1.5]}),
        ("gain_drift", {"times": [0.0, 1.0], "gains": [0.0, 0.1], "origin": 0.0}),
        ("gain_drift", {"times": [1.0], "gains": [-1.0], "origin": 0.0}),
        ("gain_drift", {"times": [1.0], "gains": [0.1, 0.2], "origin": 0.0}),
        ("gain_drift", {"times": [1.0], "gains": [0.1], "origin": None}),
        ("thermal_drift", {"times": [1.0, 1.0], "values": [0.0, 0.0]}),
        ("steps", {"times": [2.0, 1.0], "sizes": [1e-8, 1e-8]}),
        ("steps", {"times": [1.0], "sizes": []}),
        ("contact", {"position": 1e-6, "gain": 0.0}),
        ("contact", {"position": None, "gain": 1.0}),
        ("sensor_periodic", {"period": 1e-7, "amplitude": 1e-7, "phase": 0.0}),
        ("hum", {"frequency": 50.0, "amplitude": 1e-9, "phase": 0.0}),
        ("hum", {"lines": []}),
        ("hum", {"lines": [LINE | {"frequency": -50.0}]}),
        ("hum", {"lines": [LINE, LINE | {"phase": None}]}),
        ("hum", {"lines": [LINE, {"frequency": 50.0}]}),
        ("hum", {"lines": [LINE] * 101}),
        ("rate_dependence", {"threshold": 1.0}),
        ("rate_dependence", RATE | {"threshold": -1.0}),
        ("rate_dependence", RATE | {"threshold": 1e6}),
        ("rate_dependence", RATE | {"onset_rate": 0.0}),
        ("rate_dependence", RATE | {"onset_rate": 1e13}),
        ("rate_dependence", RATE | {"reversible_gain": -1e-9}),
        ("rate_dependence", RATE | {"reversible_gain": float("nan")}),
        ("rate_dependence", RATE | {"initial": 0.0}),
        ("rate_dependence", RATE | {"initial": [0.0, float("inf")]}),
        ("rate_dependence", RATE | {"coercivity": 1.0}),
        ("gremlins", {}),
        (None, {}),
        ([], {}),
    ],
)
def test_what_makes_no_sense_is_refused(name, parameters):
    with pytest.raises(SlpiError, match="^[^\n]+$"):
        from_document({"name": name, "parameters": parameters})


@pytest.mark.parametrize("uncertainty", [{"gain": 1.0}, {"time_constant": -1.0}, {"time_constant": float("nan")}, [1]])
def test_uncertainties_that_make_no_sense(uncertainty):
    with pytest.raises(SlpiError):
        from_document({"name": "lag", "parameters": {"time_constant": 0.1}, "uncertainty": uncertainty})
