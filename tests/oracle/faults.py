"""Failures by their definition: plain loops, nothing of ours but the numbers of `oracle.radio`."""

from oracle.radio import uniform

KEY = 1 << 25


def has_failed(
    seed: int, env: int, episode: int, robot: int, step: int, probability: float, length: int, steps: int, at: int = -1
) -> bool:
    """Whether a robot has failed in a local step of an episode of `length`; failures last so many `steps`."""
    begins = [at] if at >= 0 else []
    if uniform(seed, env, episode, 0, KEY + 2 * robot) < probability:
        begins.append(int(uniform(seed, env, episode, 0, KEY + 2 * robot + 1) * length))
    return any(first <= step < first + steps for first in begins)
