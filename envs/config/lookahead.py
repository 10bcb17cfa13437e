"""How `policy=lookahead` plans."""

from dataclasses import dataclass
from typing import Literal

from maexp.envs.config.group import Group
from maexp.envs.config_fields import setting

MOST_CANDIDATES = 64
MOST_HORIZON = 100


@dataclass(frozen=True)
class LookaheadConfig(Group):
    """How `policy=lookahead` and the reference `clairvoyant` plan (docs/lookahead.md).

    Each robot tries ``candidates`` targets, its own choice among them, in a simulated future of ``horizon``
    decisions, the first among them, in which ``rollout_policy`` plays on. A branch is worth what it covers, on average
    over that time, and ``rest`` times what it has covered at its end; less ``loss`` for every robot lost; and ``prior``
    times what the target is worth to `cost_utility`, or to ``rollout_policy`` where that is a trained policy (by its
    name or folder; then `cost_utility` plays on). All of it counts in radar discs. The best branch is taken if it is
    worth ``margin`` more than the own choice. ``unknown`` says what is taken to stand where nobody has looked: ``free``
    ground, what the ``nearest`` known cell holds, or what the map predictor says (``predicted``).
    """

    group = "lookahead"

    rollout_policy: str = setting(
        "multi_criteria",
        "chooses where no branch is better, and plays on; or a trained one, for which cost_utility plays on",
    )
    candidates: int = setting(
        5, "targets that each robot tries, its own choice among them", low=1, high=MOST_CANDIDATES
    )
    horizon: int = setting(1, "decisions that are played, the first among them", low=1, high=MOST_HORIZON)
    local_steps: int | None = setting(
        None,
        "control steps of 0.1 s in a decision that is played; default: of the scenario's protocol, or as "
        "scenario.local_steps where that is set",
        low=1,
    )
    unknown: Literal["free", "nearest", "predicted"] = setting(
        "free", "what is taken to stand where nobody has looked; nearest: what the nearest known cell holds; predicted"
    )
    margin: float = setting(
        0.02, "how much more than the own choice a branch must be worth to be taken", unit="radar discs", low=0
    )
    loss: float = setting(1.0, "what a robot lost costs", unit="radar discs", low=0)
    rest: float = setting(1.0, "weight of what is covered at a branch's end beside the average over its time", low=0)
    prior: float = setting(
        0.7, "weight of what the target is worth to cost_utility beside what the branch covers", low=0
    )
