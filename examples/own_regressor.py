"""An own residual regressor: anything of scikit-learn's fits the residuals.

Here random features of an RBF kernel under ridge regression; `Sklearn("SVR",
{"C": 10.0})` names a regressor instead, as `algorithm/regressor=sklearn` does in YAML.
"""

import pandas as pd
from sklearn.kernel_approximation import Nystroem
from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from bcrl.api import FQI, Boost, CarOnHill, Forest, Sklearn, run, stages

tasks = [CarOnHill(mass=mass) for mass in (0.8, 1.2)]
kernel = make_pipeline(
    StandardScaler(), Nystroem(gamma=0.5, n_components=100), Ridge(1e-3)
)
regressors = {"RBF": Sklearn(kernel), "forest": Forest(trees=20)}
settings = {"iterations": 4, "evaluate_every": 4, "episodes": 100}
frames = {
    name: run(
        stages(tasks, FQI(**settings, regressor=regressor), Boost()),
        seeds=range(2),
        metrics=("q_error", "return"),
        progress=False,
    )
    for name, regressor in regressors.items()
}
results = pd.concat(frames, names=["regressor", "row"])

ends = results[results.iteration % 4 == 0]  # of each task
print(ends.groupby(["regressor", "task"])[["q_error", "return"]].mean().round(3))
