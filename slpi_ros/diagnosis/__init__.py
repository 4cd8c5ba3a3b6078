"""What a model gets wrong on a record, and why."""
