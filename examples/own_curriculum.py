"""An own curriculum on a Gymnasium environment: a mountain car whose engine weakens.

The usual engine (0.001) never gets a randomly acting car up the hill within 200 steps,
so there is nothing to learn from; through stronger engines there is, and boosting keeps
what they have taught.
"""

import pandas as pd

from bcrl.api import FQI, Boost, Forest, Gymnasium, run, stages

forces = (0.005, 0.003, 0.0018, 0.001)  # the last is MountainCar-v0's own
tasks = [
    Gymnasium("MountainCar-v0", attributes={"force": force}, starts=5)
    for force in forces
]
settings = {"iterations": 15, "evaluate_every": 15, "episodes": 100, "epsilon": 0.3}
learner = FQI(**settings, regressor=Forest(trees=20))
methods = [
    stages(tasks[-1:] * 4, learner),  # FQI
    stages(tasks, learner),  # C-FQI
    stages(tasks, learner, Boost()),  # BC-FQI
]
results = pd.concat(run(each, seeds=range(2), progress=False) for each in methods)

last = results[results.iteration == results.iteration.max()]
print(last.groupby("method")[["return", "solved"]].mean())
