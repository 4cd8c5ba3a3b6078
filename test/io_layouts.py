"""Samples of one record, and what programs write around them."""

import numpy as np

N = 60
T = np.round(np.arange(N) * 0.005, 4)
V = np.round(50.0 - 50.0 * np.cos(np.arange(N) / 9.0), 4)
# With hysteresis: no straight line of the voltage.
Y = np.round(0.2 * V + 1.5 * np.sin(np.arange(N) / 9.0), 4)
ROWS = list(zip(T.tolist(), V.tolist(), Y.tolist(), strict=True))


def lines(separator="\t", *, end="", form="{:.4f}", comma=False, rows=ROWS):
    text = "".join(separator.join(form.format(x) for x in row) + end + "\n" for row in rows)
    return text.replace(".", ",") if comma else text


LABVIEW = """LabVIEW Measurement\t
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t{mark}
Multi_Headings\tNo
X_Columns\t{columns}
Time_Pref\tAbsolute
Operator\tuser
Date\t2024/03/05
Time\t10:30:25,201000213623046875
***End_of_Header***\t
\t
Channels\t2\t\t
Samples\t60\t60\t
Date\t2024/03/05\t2024/03/05\t
Time\t10:30:25.375\t10:30:25.375\t
Y_Unit_Label\tVolts\tVolts\t
X_Dimension\tTime\tTime\t
X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t
Delta_X\t0.005000\t0.005000\t
***End_of_Header***\t\t\t
X_Value\tPiezo voltage\tPosition (um)\tComment
"""
RIGOL = "X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,-1.500000e+01,5.000000e-03\n"
SETTINGS = ("Record Length", "60", "Points"), ("Sample Interval", "0.005", "s"), ("Trigger Point", "30", "Samples")


def settings_beside(rows):
    """Return rows as Tektronix writes them: settings in the first columns of the first rows."""
    beside = [*SETTINGS, *[("", "", "")] * (len(rows) - len(SETTINGS))]
    return "".join(",".join([*one, *map(repr, row)]) + ",\n" for one, row in zip(beside, rows, strict=True))


STRUCTURE = {
    "time": T[:, None],
    "signals": {"values": np.c_[V, Y], "dimensions": 2.0, "label": ""},
    "blockName": "model/Scope",
}
SIGNALS = np.empty((1, 2), object)
SIGNALS[0] = [{"values": V[:, None], "label": "voltage_V"}, {"values": Y[:, None], "label": "position_um"}]
DSPACE = {
    "X": {"Name": "Time", "Data": T[None], "Unit": "s"},
    "Y": [
        {"Name": '"Model Root"/"drive"', "Data": V[None], "Unit": "V"},
        {"Name": "Position", "Data": Y[None], "Unit": "um"},
    ],
    "Description": {"General": "capture"},
}
