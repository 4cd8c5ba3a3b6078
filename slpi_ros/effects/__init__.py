"""What a stage does beside its hysteresis: ten effects, each with the same verbs."""
