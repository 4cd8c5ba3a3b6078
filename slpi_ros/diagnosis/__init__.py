"""Diagnosis of model errors on records, and verification of models."""
