"""Curricula: the order in which the stages of a run visit an environment's tasks."""


def hand_made(n_tasks: int) -> list[int]:
    """Every task once, the easiest first, the target last (`curriculum=on`)."""
    return list(range(n_tasks))


def target_only(n_tasks: int) -> list[int]:
    """The target in every stage (`curriculum=off`)."""
    return [n_tasks - 1] * n_tasks


CURRICULA = {"on": hand_made, "off": target_only}
