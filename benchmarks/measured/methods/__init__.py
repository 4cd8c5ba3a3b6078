"""The methods that are compared, in the order of the table; a file for each family."""

from benchmarks.measured.methods.base import Fitted, Invertible, Method, Series, chosen_history, possible_histories
from benchmarks.measured.methods.gru import GRU
from benchmarks.measured.methods.linear import LINE, PI, PI_CREEP, PI_LAG, PI_RATE, PREISACH, likely_history
from benchmarks.measured.methods.narx import NARX
from benchmarks.measured.methods.nonlinear import BOUC_WEN, GENERALISED_PI, MODIFIED_PI
from benchmarks.measured.methods.slpi import SLPI, SLPI_CAUSES

METHODS: tuple[Method, ...] = (
    LINE,
    PI,
    PI_LAG,
    MODIFIED_PI,
    GENERALISED_PI,
    PI_RATE,
    PI_CREEP,
    BOUC_WEN,
    PREISACH,
    NARX,
    GRU,
    SLPI,
    SLPI_CAUSES,
)

__all__ = [
    "METHODS",
    "Fitted",
    "Invertible",
    "Method",
    "Series",
    "chosen_history",
    "likely_history",
    "possible_histories",
]
