"""Simulators side by side; one that fails is a failed lane, the others go on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bcrl.common.serialization import DERIVED, storable
from bcrl.envs._contract import LARGEST, Broken, Simulator

if TYPE_CHECKING:
    from bcrl.envs.gymnasium import Gymnasium

#: Seeds of a reset lie below this: every 32-bit generator takes them.
SEEDS = 2**31


@storable
@dataclass(eq=False)
class SimulatedLanes:
    """Simulators that are stepped side by side; `lanes` index their leading axes.

    An episode follows from what its lane was reset by and the actions since. Only that
    is stored: lanes out of a checkpoint replay it, and fail where they end elsewhere.
    `failures` says why a lane failed, by its number in C order. Such a lane has been
    closed; it gives observations and rewards of 0 and is always truncated.
    """

    env: Gymnasium
    start: NDArray[np.float64] | None = None  # (…, 1) in [0, 1)
    taken: NDArray[np.int16] | None = None  # (…, horizon) actions
    length: NDArray[np.intp] | None = None  # (…) how many of them
    seen: NDArray[np.float64] | None = None  # (…, d) the latest observations
    failures: dict[int, str] = field(default_factory=dict)
    running: list[Simulator | None] = field(default_factory=list, metadata=DERIVED)
    render_mode: str | None = None
    #: Whether every episode needs a new simulator.
    fresh: bool = field(default=False, metadata=DERIVED)
    #: (…) whether the latest info reported success
    succeeded: NDArray[np.bool_] | None = field(default=None, metadata=DERIVED)

    def begin(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reset every lane; the observations (…, d)."""
        shape = start.shape[:-1]
        self.close()
        self.start, self.failures = start.copy(), {}
        self.length = np.zeros(shape, np.intp)
        self.taken = np.zeros((*shape, self.env.horizon), np.int16)
        self.seen = np.zeros((*shape, self.env.state_dim))
        self._open_all()
        return self.restart(np.ones(shape, bool), start, self.seen)

    def step(
        self,
        state: NDArray[np.float64] | None,
        action: NDArray[np.integer],
        noise: NDArray[np.float64] | None,
        lanes: Any = ...,
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """A step of the chosen lanes: observations, rewards, terminated, truncated."""
        self._wake()
        chosen = self._numbers[lanes].reshape(-1)
        acts, length = action.reshape(-1), self.length.reshape(-1)
        self.taken.reshape(len(length), -1)[chosen, length[chosen]] = acts
        length[chosen] += 1
        after = np.zeros((len(chosen), self.env.state_dim))
        reward, ended = np.zeros(len(chosen)), np.zeros((2, len(chosen)), bool)
        flags = self.succeeded.reshape(-1)
        pairs = zip(chosen.tolist(), acts.tolist(), strict=True)
        for i, (lane, act) in enumerate(pairs):
            if lane in self.failures:
                continue
            try:
                found = self.running[lane].step(act)
            except Broken as error:
                self._fail(lane, error)
            else:
                after[i], reward[i], *ended[:, i], flags[lane] = found
        self._check("step", chosen, after, reward)
        if self.failures:
            lost = np.isin(chosen, list(self.failures))
            after[lost], reward[lost] = 0.0, 0.0
            ended[0, lost], ended[1, lost] = False, True
        self.seen.reshape(len(length), -1)[chosen] = after
        shape = action.shape
        return (
            after.reshape(*shape, -1),
            reward.reshape(shape),
            *ended.reshape(2, *shape),
        )

    def restart(
        self,
        over: NDArray[np.bool_],
        start: NDArray[np.float64],
        state: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """All observations, those of lanes that are over after a reset."""
        self._wake()
        state = state.copy()
        self.start[over], self.length[over] = start[over], 0
        chosen = self._numbers[over].tolist()
        fresh = np.zeros((len(chosen), self.env.state_dim))
        for i, lane in enumerate(chosen):
            fresh[i] = self._reset(lane)
        self._check("reset", chosen, fresh, np.zeros(len(chosen)))
        if self.failures:
            fresh[np.isin(chosen, list(self.failures))] = 0.0
        state[over] = self.seen[over] = fresh
        return state

    def close(self) -> None:
        """Close every simulator."""
        for simulator in self.running:
            if simulator is not None:
                simulator.close()
        self.running = []

    @property
    def _numbers(self) -> NDArray[np.intp]:
        return np.arange(self.length.size).reshape(self.length.shape)

    def _reset(self, lane: int) -> NDArray[np.float64] | float:
        """A lane's first observation; 0 if it has failed."""
        seed = int(self.start.reshape(-1)[lane] * SEEDS)
        if self.fresh and lane not in self.failures and self.running[lane].used:
            self._open(lane)
        for _ in range(2):
            if lane in self.failures:
                break
            used = self.running[lane].used
            try:
                return self.running[lane].reset(seed)
            except Broken as error:
                if not used:
                    self._fail(lane, error)
                else:  # perhaps it allows no reset before the end of an episode
                    self._open(lane)
        return 0.0

    def _fail(self, lane: int, error: Broken) -> None:
        self.failures[lane] = str(error)
        if simulator := self.running[lane]:
            simulator.close()
        self.running[lane] = None

    def _open(self, lane: int) -> None:
        if self.running[lane]:
            self.running[lane].close()
        try:
            self.running[lane] = Simulator(self.env, self.render_mode)
        except Broken as error:
            self.running[lane] = None
            self._fail(lane, error)

    def _open_all(self) -> None:
        self.running, self.fresh = [None] * self.length.size, self.env.fresh
        self.succeeded = np.zeros(self.length.shape, bool)
        for lane in range(self.length.size):
            if lane not in self.failures:
                self._open(lane)

    def _wake(self) -> None:
        """Bring lanes that come out of a checkpoint to where they were."""
        if self.running or not self.length.size:
            return
        self._open_all()
        taken = self.taken.reshape(self.length.size, -1)
        seen = self.seen.reshape(self.length.size, -1)
        for lane, length in enumerate(self.length.reshape(-1).tolist()):
            now = self._reset(lane)
            for action in taken[lane, :length].tolist():
                if lane in self.failures:
                    break
                try:
                    now = self.running[lane].step(action)[0]
                except Broken as error:
                    self._fail(lane, error)
            if lane not in self.failures and not np.array_equal(now, seen[lane]):
                came = f"another observation after {length} steps of a replay"
                why = "the same after the same reset(seed=…) and actions"
                self._fail(lane, self.running[lane].broken("step", came, why))

    def _check(self, method: str, chosen: Any, seen: NDArray, reward: NDArray) -> None:
        """Fail the lanes whose numbers no learner can use."""
        fits = (np.abs(seen) <= LARGEST).all(-1) & np.isfinite(reward)
        for i in np.flatnonzero(~fits):
            lane = int(chosen[i])
            if lane not in self.failures:
                error = self.running[lane].unfit(method, seen[i], reward[i])
                self._fail(lane, error)
