"""A simulated stage whose physics is none of the compensator's models."""
