"""What the MPI paper prints: Tables 1 to 6, and the errors of its feedforward and compound control."""

# By amplitude (V): a (µm) and b of Eq. 1.
TABLE_1: dict[float, tuple[float, float]] = {
    20: (12.306, -0.017),
    40: (27.235, -0.018),
    60: (43.448, -0.017),
    80: (59.669, -0.014),
    100: (75.08, -0.013),
    120: (89.189, -0.012),
}
# MPI, by amplitude (V): maximum, mean and "mean square" error, which is its root (µm); then R².
TABLE_2: dict[float, tuple[float, float, float]] = {
    20: (0.4215, 0.1184, 0.1451),
    40: (1.0007, 0.2306, 0.3164),
    60: (0.9785, 0.2554, 0.3217),
    80: (1.2104, 0.2753, 0.3611),
    100: (1.0687, 0.2941, 0.3724),
    120: (1.4441, 0.4002, 0.5053),
}
TABLE_3: dict[float, float] = {20: 0.9960, 40: 0.9983, 60: 0.9993, 80: 0.9996, 100: 0.9997, 120: 0.9996}
# SMPI, likewise.
TABLE_4: dict[float, tuple[float, float, float]] = {
    20: (0.7348, 0.1936, 0.2692),
    40: (1.0278, 0.3300, 0.3986),
    60: (1.7215, 0.5507, 0.6678),
    80: (1.5595, 0.6115, 0.7322),
    100: (1.7403, 0.7126, 0.8491),
}
TABLE_5: dict[float, float] = {20: 0.9939, 40: 0.9973, 60: 0.9970, 80: 0.9982, 100: 0.9985}
# Expected displacement (µm) and frequency (Hz) of the five segments.
TABLE_6 = ((60, 1), (80, 1), (100, 1), (80, 2), (80, 3))

# Mean and "mean square" error (µm), and the band (µm) in which errors basically are: Fig. 11, then Fig. 13 and 14.
FEEDFORWARD_MEAN, FEEDFORWARD_ROOT, FEEDFORWARD_BAND = 0.0485, 0.1201, 1.0
COMPOUND_MEAN, COMPOUND_ROOT, COMPOUND_BAND = 0.1192, 0.2949, 0.5
