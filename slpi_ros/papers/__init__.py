"""The two papers' tables and figures, computed anew on simulated and measured stages."""
