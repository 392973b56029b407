"""When an episode counts as solved: named rules, and a default for simulators."""

from __future__ import annotations

from typing import NamedTuple

#: The rules of `env.success`, and the condition that solves an episode.
RULES = {
    "absorbed": "the episode terminated",
    "survived": "the episode was truncated, it never terminated",
    "unpunished": "the episode terminated with a reward of 0 or more",
    "rewarded": "the episode terminated with a reward above 0",
    "threshold": "the undiscounted return reached env.success_threshold",
    "info": 'info["is_success"] or info["success"] held after the last step',
}


class Success(NamedTuple):
    """A rule by name; `threshold` is the return that the rule `threshold` needs."""

    rule: str = "unpunished"
    threshold: float = 0.0

    def __str__(self) -> str:
        if self.rule != "threshold":
            return f"{self.rule} ({RULES[self.rule]})"
        return f"threshold (the undiscounted return reached {self.threshold:g})"


def default_success(
    reports: bool, low: float, high: float, threshold: float | None
) -> Success:
    """The rule that suits the rewards of random play.

    `reports`: info has a success key. `low`, `high`: least and largest reward of the
    steps that did not terminate. `threshold`: the registered `reward_threshold`.
    """
    if reports:
        return Success("info")
    if low == high:  # every step costs the same, pays the same, or gives 0
        return Success("absorbed" if low < 0 else "survived" if low > 0 else "rewarded")
    if threshold is not None and not high < 0 < threshold:
        return Success("threshold", float(threshold))
    if threshold is None and high < 0:
        return Success("absorbed")
    return Success("survived" if low > 0 else "rewarded")
