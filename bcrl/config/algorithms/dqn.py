"""DQN's settings, and the stages they make, LSPI's pretraining among them."""

from bcrl.common.checks import construct, one_of
from bcrl.common.identity import Plain
from bcrl.config.algorithms import per_slot
from bcrl.config.rules import check_lspi, course
from bcrl.config.variant import Composition
from bcrl.errors import ConfigError
from bcrl.learning.dqn import DQN
from bcrl.learning.lspi import LSPI
from bcrl.learning.stage import Learner, Stage
from bcrl.learning.transfer import warm_start

FAMILY = "DQN"
LOCKSTEP = 20
_PER_SLOT = (
    *("learners", "steps", "epsilon", "epsilon_start", "anneal_steps"),
    *("target_update", "evaluate_every", "evaluation_episodes", "evaluation_epsilon"),
)


def stages(section: Plain, chosen: Composition) -> tuple[Stage, ...]:
    """The course that DQN makes of the slots, LSPI in the first where it can."""
    settings = {key: value for key, value in section.items() if key != "name"}
    pretraining = settings.pop("lspi", None)
    if not isinstance(pretraining, dict):
        raise ConfigError("algorithm.lspi", pretraining, "must be a section")
    check_lspi(construct("algorithm.lspi", LSPI, pretraining))
    learners: list[Learner] = []
    for slot, own in enumerate(per_slot(settings, _PER_SLOT, len(chosen.order))):
        kind = own.pop("learners", "auto")
        one_of("algorithm.learners", kind, ("auto", "dqn", "lspi"))
        dqn: DQN = construct("algorithm", DQN, own)
        lq = getattr(chosen.slots[slot], "linear_quadratic", None) is not None
        first = slot == 0 and not chosen.past and chosen.transfers != (warm_start,)
        if kind == "lspi" or (kind == "auto" and lq and first):
            shared = {k: getattr(dqn, k) for k in ("steps", "evaluation_episodes")}
            learners.append(construct("algorithm.lspi", LSPI, pretraining | shared))
        else:
            learners.append(dqn)
    return course(chosen, learners)
