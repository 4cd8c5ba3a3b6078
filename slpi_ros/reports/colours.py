"""The colours of every picture: each means the same wherever it is seen."""

MEASURED, DESIRED, NOISE = "#8a97a5", "#1b2733", "#c9d2da"
COLOURS = ("#c8553d", "#d99a26", "#2a7f62", "#3b6ea5")
# Of what a model was not fitted to: the time, what was measured there, and what the model says.
UNFITTED_SHADE, UNFITTED_MEASURED, UNFITTED_MODEL = "#fbeccb", "#e6cc94", "#b98a2f"
BEFORE, AFTER = COLOURS[0], COLOURS[2]
# Of causes, in order of their weight; none is like BEFORE or AFTER.
CAUSES = ("#3b6ea5", "#d99a26", "#8d5fb0", "#1f9aa6", "#b5467d", "#7a6a53")
# From few to many, and from little to much: dark on white, told apart by everyone.
SCALE = ((0.0, "#c3d8ea"), (0.5, "#5b8db8"), (1.0, "#173a5c"))
ERROR_SCALE = ((0.0, "#c9e4d8"), (0.5, "#e0b04a"), (1.0, "#a8321c"))
