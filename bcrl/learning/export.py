"""A kept agent for other programs: ONNX for networks, NPZ for every Q-function.

docs/howto/agents.md describes both files.
"""

import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common.files import write_bytes
from bcrl.errors import BcrlError
from bcrl.learning.agent import Agent
from bcrl.learning.policies import combined_actions
from bcrl.learning.transfer import Acting
from bcrl.q.forest.forest import Forest
from bcrl.q.forest.split import value_of
from bcrl.q.functions import ZERO, Q, Scaled, Shaped, Sum, Table
from bcrl.q.quadratic import Quadratic
from bcrl.q.regressors.base import FittedQ

Put = Callable[..., dict[str, Any]]


def export(agent: Agent, path: str | Path) -> Path:
    """Write an agent's Q and greedy policy to `path`, which ends with .onnx or .npz.

    Raises BcrlError for another ending, and for a Q-function that ONNX can't hold.
    """
    path = Path(path)
    writers = {".onnx": _onnx, ".npz": _npz}
    if path.suffix not in writers:
        raise BcrlError(f"{path}: must end with .onnx or .npz")
    if not (folder := path.absolute().parent).is_dir():
        raise BcrlError(f"{path}: there is no folder {folder}")
    return write_bytes(path, writers[path.suffix](agent))


def layers_of(q: Q) -> list[tuple[NDArray, NDArray]]:
    """A network's weights (in, out) and biases (out,), layer by layer."""
    online = getattr(q, "online", None)
    if online is None:
        raise BcrlError(f"{type(q).__name__}: this kind of Q-function isn't exported")
    pairs = ((weights[0], biases[0, 0]) for weights, biases in online.layers)
    return [(w.cpu().numpy(), b.cpu().numpy()) for w, b in pairs]


def _npz(agent: Agent) -> bytes:
    """Arrays, and the JSON text `about` that says how Q and policy are made of them."""
    arrays: dict[str, Any] = {}
    labels: dict[int, str] = {}

    def put(of: Any, kind: str, **parts: NDArray) -> dict[str, Any]:
        if id(of) not in labels:
            label = labels[id(of)] = f"{kind}_{len(labels)}"
            arrays.update({f"{label}.{name}": part for name, part in parts.items()})
        return {kind: labels[id(of)]}

    result, task = agent.learned.result, agent.task
    acting = result.acting or Acting(result.q, np.zeros(1, bool))
    own = acting.prior if acting.copying[0] else acting.own
    policy = {"greedy": _described(own, put)}
    if acting.prior is not ZERO:
        table = combined_actions(task.actions)
        policy |= {"prior": _described(acting.prior, put)}
        policy |= put(acting, "combined", actions=table)
    about = {"q": _described(result.q, put), "policy": policy, "task": repr(task)}
    np.savez(file := io.BytesIO(), about=np.array(json.dumps(about)), **arrays)
    return file.getvalue()


def _described(q: Q, put: Put) -> Any:
    """A Q-function as nested sums of what was `put` among the arrays."""
    if q is ZERO:
        return {"sum": []}
    if isinstance(q, Sum):
        return {"sum": [_described(term, put) for term in q.terms]}
    if isinstance(q, Scaled):
        return {"scaled": {"factor": float(q.factor[0]), "q": _described(q.q, put)}}
    if isinstance(q, Shaped):
        parts = {"base": q.base, "residual": q.residual, "potential": q.potential}
        return {"shaped": {name: _described(part, put) for name, part in parts.items()}}
    if isinstance(q, Table):
        return put(q, "table", states=q.env.states(), values=np.asarray(q.values[0]))
    if isinstance(q, Quadratic):
        own = {"matrix": q.matrix[0], "linear": q.linear[0], "actions": q.actions}
        return put(q, "quadratic", **own)
    if isinstance(q, FittedQ):
        q.refit()
        models = [None if fitted is None else fitted.model for fitted in q.models[0]]
        forests = [model and put(model, "forest", **_trees(model)) for model in models]
        return {"actions": forests}
    named = enumerate(layers_of(q))
    flat = {f"{'wb'[i]}{k}": x for k, layer in named for i, x in enumerate(layer)}
    return put(q, "network", **flat)


def _trees(model: Any) -> dict[str, NDArray]:
    """A forest's nodes as arrays: rows with x[feature] <= threshold go left."""
    if not isinstance(model, Forest):
        raise BcrlError(f"{type(model).__name__}: of trees, only our own are exported")
    nodes = model.nodes
    leaf, cut = nodes["feature"] < 0, value_of.__wrapped__(nodes["cut"])  # not compiled
    value = np.where(leaf, model.values[np.where(leaf, nodes["child"], 0)], np.nan)
    return {
        "feature": nodes["feature"],
        "threshold": np.where(leaf, np.float32(np.nan), cut),
        "left": np.where(leaf, -1, nodes["child"]),  # the right child follows it
        "value": value,
        "roots": model.first[:-1],
    }


def _onnx(agent: Agent) -> bytes:
    """A graph from `observation` (n, d) float64 to `q` (n, A) and `action` (n,)."""
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError as error:
        why = "needs onnx: pip install 'boosted-curriculum-rl[onnx]'"
        raise BcrlError(f".onnx {why}") from error
    nodes: list[Any] = []
    constants: dict[str, Any] = {}
    made: dict[int, str] = {}

    def constant(array: Any) -> str:
        name = f"c{len(constants)}"
        constants[name] = numpy_helper.from_array(np.ascontiguousarray(array), name)
        return name

    def node(operator: str, *inputs: str, **attributes: Any) -> str:
        name = f"t{len(nodes)}"
        nodes.append(helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def values(q: Q) -> str:
        if id(q) not in made:
            made[id(q)] = _values(q)
        return made[id(q)]

    def total(terms: Sequence[Q]) -> str:
        first, *rest = (values(term) for term in terms if term is not ZERO)
        for term in rest:
            first = node("Add", first, term)
        return first

    def _values(q: Q) -> str:
        if isinstance(q, Sum):
            return total(q.terms)
        if isinstance(q, Scaled):
            return node("Mul", values(q.q), constant(q.factor))
        if isinstance(q, Shaped):
            own, axes = total((q.base, q.residual)), constant(np.array([1]))
            return node("Add", own, node("ReduceMax", values(q.potential), axes))
        if isinstance(q, Quadratic):
            pure, cross, alone = (part[0] for part in q._parts)
            square = node(
                "Mul", node("MatMul", "observation", constant(pure)), "observation"
            )
            square = node("ReduceSum", square, constant(np.array([1])))
            linear = node("MatMul", "observation", constant(cross))
            return node("Add", node("Add", linear, square), constant(alone))
        x = node("Cast", "observation", to=TensorProto.FLOAT)
        for number, (weights, biases) in enumerate(layers_of(q)):
            x = node("Relu", x) if number else x
            x = node("Gemm", x, constant(weights), constant(biases))
        return node("Cast", x, to=TensorProto.DOUBLE)

    result = agent.learned.result
    q, acting = values(result.q), result.acting
    action = node(
        "ArgMax", values(acting.own if acting else result.q), axis=1, keepdims=0
    )
    if acting and acting.prior is not ZERO:
        advised = node("ArgMax", values(acting.prior), axis=1, keepdims=0)
        action = advised if acting.copying[0] else action
        n_actions = constant(np.array(agent.task.n_actions))
        place = node("Add", node("Mul", advised, n_actions), action)
        table = combined_actions(agent.task.actions).astype(np.int64)
        action = node("Gather", constant(table.reshape(-1)), place)
    nodes += [
        helper.make_node("Identity", [q], ["q"]),
        helper.make_node("Identity", [action], ["action"]),
    ]
    tensor, n = helper.make_tensor_value_info, agent.task.n_actions
    seen = tensor("observation", TensorProto.DOUBLE, ["n", agent.task.state_dim])
    given = [tensor("q", TensorProto.DOUBLE, ["n", n])]
    given += [tensor("action", TensorProto.INT64, ["n"])]
    graph = helper.make_graph(nodes, "agent", [seen], given, [*constants.values()])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)])
    model.ir_version = 9  # which runtimes of the last years read
    checker.check_model(model)
    return model.SerializeToString()
