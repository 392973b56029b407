"""Experiments that are not in the paper; each is a command of its own."""
