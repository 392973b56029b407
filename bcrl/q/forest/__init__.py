"""Extremely randomised trees, compiled; `forest` has the entry points."""
