"""Settings that DQN and its transfers can't have are rejected by key and value."""

import pytest
import torch

from bcrl.errors import BcrlError
from tests.conftest import plan

LINEAR = "env=linear_system algorithm=dqn"
BAD = {
    "algorithm.target_update=0": "target_update=0",
    "algorithm.replay_size=16": "replay_size=16",
    "algorithm.learning_starts=10000": "replay_size=10000",
    "algorithm.hidden=[]": "algorithm.hidden=[]",
    "algorithm.learning_rate=0": "learning_rate=0",
    "algorithm.learners=dqm": "did you mean dqn?",
    "variant=BC algorithm.learners=lspi": "algorithm.learners=lspi",
    "variant=C algorithm.learners=[lspi,dqn]": "leaves no network",
    "variant=BC algorithm.steps=[2100,500]": "algorithm.steps=2100",
    "variant=BC algorithm.lspi.features=cubic": "algorithm.lspi.features=cubic",
    "env.tasks.task=[target] env.tasks.horizon=[150] transfer=shaping": "one task",
    "transfer=policy_reuse": "needs an earlier task",
    "transfer=residual_policy": "an earlier task",
    "curriculum=on transfer=residual_policy boosting=on": "residual_policy",
    "transfer=shapin": "did you mean transfer=shaping?",
    "variant=PPR transfer.nu=1.5": "transfer.nu=1.5",
    "variant=RPL transfer.offset=-1": "transfer.offset=-1",
    "boosting=on boosting.maxima=three": "boosting.maxima=three",
    "env.preset=relesed": "did you mean released?",
    "env.tasks.task=[lq,targt]": "did you mean target?",
    "device=gpu": "device=gpu",
    "env=maze algorithm=fqi boosting=released": "boosting=released",
    "env=maze algorithm=fqi curriculum=on transfer=policy_reuse": "FQI",
}


@pytest.mark.parametrize("words", BAD)
def test_bad_input_is_rejected(words):
    chosen = () if words.startswith("env=maze") else LINEAR.split()
    with pytest.raises(BcrlError) as rejected:
        plan(*chosen, *words.split())
    assert BAD[words] in str(rejected.value)


def test_a_missing_cuda_device_is_rejected():
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    with pytest.raises(BcrlError, match="device=cuda"):
        plan(*LINEAR.split(), "device=cuda")


def test_sb_dqn_is_named_so():
    p = plan(*LINEAR.split(), "boosting=on", "transfer=shaping")
    assert p.variant == "SB-DQN" and {s.task for s in p.stages} == {2}
