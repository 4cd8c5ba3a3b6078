"""From a record to a model."""
