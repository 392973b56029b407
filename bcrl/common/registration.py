"""Our tasks as environments of Gymnasium, registered by strings: `bcrl/Maze-v0` etc.

Importing bcrl must stay light, so this module does not import Gymnasium: it registers
the tasks once Gymnasium is imported, before or after bcrl.
"""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

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
    def find_spec(name: str, path: object = None, target: object = None) -> object:
        """Gymnasium's own spec, whose loader registers the tasks afterwards."""
        if name != "gymnasium":
            return None
        sys.meta_path.remove(_Hook)  # type: ignore[arg-type]
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def then_register(module: ModuleType) -> None:
                execute(module)
                register()

            spec.loader.exec_module = then_register  # type: ignore[method-assign]
        return spec


def register_with_gymnasium() -> None:
    """Register now if Gymnasium is imported already, else when it is."""
    if "gymnasium" in sys.modules:
        register()
    elif _Hook not in sys.meta_path:
        sys.meta_path.insert(0, _Hook)  # type: ignore[arg-type]
