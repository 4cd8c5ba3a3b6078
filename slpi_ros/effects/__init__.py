"""What a stage does beside its hysteresis: eleven effects, each with the same verbs."""
