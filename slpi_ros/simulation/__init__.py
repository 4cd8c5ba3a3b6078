"""A simulated stage with physics that are independent of the compensator's models."""
