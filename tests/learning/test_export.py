"""Agents in other programs: ONNX run by onnxruntime, NPZ read with NumPy alone."""

import json
import os

import numpy as np
import pytest

import bcrl
from bcrl.errors import BcrlError
from tests.run.runs import KINDS, run

NETWORKS = ("dqn plain", "dqn BC", "dqn SBC", "dqn RPL", "dqn SBC_released")
NETWORKS += ("dqn SBC_line_search",)
OTHERS = ("maze BC", "car_on_hill BC", "car_on_hill SC", "maze SBC_line_search")


def states_of(agent):
    """States of the agent's task, from its own episodes and beside them."""
    if agent.task.name == "maze":
        return agent.task.states()
    rng, env = np.random.default_rng(0), agent.make()
    starts = np.array([env.reset(seed=seed)[0] for seed in range(20)])
    return (starts[:, None] + rng.normal(0, 0.5, (20, 100, starts.shape[1]))).reshape(
        2000, -1
    )


def q_of(about, arrays, x):
    """Q at x (n, d), as docs/howto/agents.md says, with NumPy alone."""
    ((kind, what),) = about.items()
    part = {
        k.partition(".")[2]: v for k, v in arrays.items() if k.startswith(f"{what}.")
    }
    if kind == "sum":
        return sum(q_of(term, arrays, x) for term in what)
    if kind == "scaled":
        return what["factor"] * q_of(what["q"], arrays, x)
    if kind == "shaped":
        base, own, v = (
            q_of(what[k], arrays, x) for k in ("base", "residual", "potential")
        )
        return base + own + v.max(1, keepdims=True)
    if kind == "table":
        at = (x[:, None] == part["states"]).all(-1).argmax(1)
        return part["values"][at]
    if kind == "quadratic":
        z = [np.hstack([x, np.tile(a, (len(x), 1))]) for a in part["actions"]]
        values = [((v @ part["matrix"]) * v).sum(1) + v @ part["linear"] for v in z]
        return np.stack(values, 1)
    if kind == "actions":
        return np.stack([forest(f, arrays, x) for f in what], 1)
    x = x.astype(np.float32)
    for k in range(len(part) // 2):
        x = (np.maximum(x, 0) if k else x) @ part[f"w{k}"] + part[f"b{k}"]
    return x.astype(float)


def actions_of(policy, arrays, x):
    """The policy's actions at x (n, d), as docs/howto/agents.md says."""
    own = q_of(policy["greedy"], arrays, x).argmax(1)
    if "prior" not in policy:
        return own
    prior = q_of(policy["prior"], arrays, x).argmax(1)
    return arrays[f"{policy['combined']}.actions"][prior, own]


def forest(about, arrays, x):
    """The mean of a forest's trees at x (n, d); 0 for an action without one."""
    if about is None:
        return np.zeros(len(x))
    label = about["forest"]
    feature, threshold, left, value, roots = (
        arrays[f"{label}.{key}"]
        for key in ("feature", "threshold", "left", "value", "roots")
    )
    x, total = x.astype(np.float32), np.zeros(len(x))
    for root in roots:
        at = np.full(len(x), root)
        while (inner := feature[at] >= 0).any():
            right = x[np.arange(len(x)), feature[at]] > threshold[at]
            at = np.where(inner, left[at] + right, at)
        total += value[at]
    return total / len(roots)


@pytest.mark.parametrize("kind", [*NETWORKS, *OTHERS])
def test_the_npz_is_all_that_another_program_needs(kind, tmp_path):
    agent = bcrl.load(run(tmp_path, *KINDS[kind]).directory)
    with np.load(bcrl.export(agent, tmp_path / "agent.npz")) as stored:
        arrays = dict(stored)
    about, x = json.loads(str(arrays["about"])), states_of(agent)
    expected = agent.q(x)
    scale = 1 + abs(expected).max()
    assert abs(q_of(about["q"], arrays, x) - expected).max() < 1e-6 * scale
    actions = actions_of(about["policy"], arrays, x)
    assert (actions == agent.act(x)).mean() > 0.999  # ties, but for rounding


@pytest.mark.parametrize("kind", [*NETWORKS, "dqn SC"])
def test_onnxruntime_computes_the_same(kind, tmp_path):
    if os.environ.get("BCRL_ENVIRONMENTS") != "required":
        pytest.importorskip("onnx")
    import onnxruntime

    agent = bcrl.load(run(tmp_path, *KINDS[kind]).directory)
    path, x = bcrl.export(agent, tmp_path / "agent.onnx"), states_of(agent)
    session = onnxruntime.InferenceSession(str(path))
    q, action = session.run(["q", "action"], {"observation": x})
    expected = agent.q(x)
    assert abs(q - expected).max() < 1e-6 * (1 + abs(expected).max())
    assert (action == agent.act(x)).mean() > 0.999  # ties, but for rounding


def test_what_cant_be_exported_is_refused(tmp_path):
    agent = bcrl.load(run(tmp_path, *KINDS["maze BC"]).directory)
    for path, why in (
        ("a.onnx", "Table|onnx"),
        ("a.pt", "must end"),
        ("b/a.npz", "no"),
    ):
        with pytest.raises(BcrlError, match=why):
            bcrl.export(agent, tmp_path / path)
