"""Diagnosis of model errors on records: the effects that a model lacks."""
