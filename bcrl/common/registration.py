"""Our tasks as environments of Gymnasium, registered by strings: `bcrl/Maze-v0` etc.

Importing bcrl must stay light, so the tasks are registered once Gymnasium is imported.
"""

import importlib.util
import sys
from typing import Any

#: Name in Gymnasium → our name, and its horizon in steps.
REGISTERED = {
    "CarOnHill": ("car_on_hill", 100),
    "LinearSystem": ("linear_system", 150),
    "Maze": ("maze", 200),
}


def register() -> None:
    """Make the tasks known to `gymnasium.make` and `make_vec`."""
    from gymnasium.envs import registration

    for name, (env, horizon) in REGISTERED.items():
        registration.register(
            f"bcrl/{name}-v0",
            entry_point="bcrl.envs.gym_api:GymEnv",
            vector_entry_point="bcrl.envs.gym_api:GymVectorEnv",
            max_episode_steps=horizon,
            kwargs={"env": env},
        )


class _Hook:
    """Registers the tasks at the end of Gymnasium's import."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> Any:
        if name != "gymnasium":
            return None
        sys.meta_path.remove(_Hook)  # type: ignore[arg-type]
        spec: Any = importlib.util.find_spec(name)
        if spec:
            execute = spec.loader.exec_module
            spec.loader.exec_module = lambda module: (execute(module), register())
        return spec


if "gymnasium" in sys.modules:
    register()
else:
    sys.meta_path.insert(0, _Hook)  # type: ignore[arg-type]
