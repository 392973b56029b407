"""What the report's tests share."""

import pytest

from bcrl.report.figures import style


@pytest.fixture(autouse=True)
def _styled():
    """Figures are drawn in the style of bcrl-report."""
    with style.sheet():
        yield
