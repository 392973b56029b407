"""Experiments that are not in the paper; each is a separate command."""
