"""Tests of logged data: which optional packages they need."""

import importlib.util
import os

import pytest

#: CI sets this, so that a missing package is a failure there.
REQUIRED = os.environ.get("BCRL_ENVIRONMENTS") == "required"


def needs(package: str) -> pytest.MarkDecorator:
    """Skips a test where an optional package is missing."""
    missing = not importlib.util.find_spec(package) and not REQUIRED
    return pytest.mark.skipif(missing, reason=f"{package} isn't installed")
