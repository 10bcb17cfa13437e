"""How long a benchmark will take on this machine, measured by a few short steps of what it is made of."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torchrl.envs.utils import step_mdp

from maexp.agents.benchmarks.plan import Cell, as_list, cell_config, length_of
from maexp.agents.build import load_maps, make_env, make_learner, set_steps
from maexp.agents.config.env import episode_decisions
from maexp.agents.config.verbs import BenchmarkSettings
from maexp.agents.errors import blame_input
from maexp.agents.policies.classical import POLICIES
from maexp.envs.scenarios import find_scenario

FRAMES = 48  # macro steps of teams in a measured batch, at least, where a batch of the training has as many
QUICK = 2.0  # seconds; a shorter first measurement is taken for the warm-up of a second one
UNKNOWN_LENGTH = 60  # macro steps of an episode on a map of the user's own, which the map decides
OVERHEAD = 3.0  # seconds of a cell that are neither training nor episodes: settings, maps, files
PLAIN = 1.0  # seconds per 1,000 macro steps assumed where nothing was measured


@dataclass
class Estimate:
    """Expected seconds of each cell.

    Attributes:
        seconds: per cell, on one worker
        workers: how many run at once
        measured: whether `seconds` come from measuring
    """

    seconds: dict[Cell, float]
    workers: int
    measured: bool = True
    details: list[str] = field(default_factory=list)

    @property
    def hours(self) -> float:
        return sum(self.seconds.values()) / self.workers / 3600 if self.measured else 0.0

    @property
    def text(self) -> str:
        """The line that is printed before a benchmark starts."""
        if not self.measured:
            return "time not estimated (estimate=false)"
        return f"estimated time: {self.describe()} (from a few measured steps: {'; '.join(self.details)})"

    def weight(self, cell: Cell) -> float:
        """How much of the whole a cell is."""
        return self.seconds[cell]

    def describe(self) -> str:
        """About how long, in the unit one would say."""
        minutes = 60 * self.hours
        for unit, size in (("years", 525_600), ("days", 1440), ("hours", 60)):
            if minutes >= 1.5 * size:
                return f"{minutes / size:.1f} {unit}"
        return f"{max(minutes, 1):.0f} minutes"


def estimate_cells(cfg: BenchmarkSettings, cells: list[Cell], suites: int, workers: int) -> Estimate:
    """Measure every scenario once, and every algorithm once, each on one map and for a few macro steps.

    Raises:
        UserError: settings or maps that cannot be used.
    """
    if not cfg.estimate:
        return Estimate({cell: _volume(cfg, cell, suites) for cell in cells}, workers, measured=False)
    scenarios = {cell.scenario: cell for cell in cells}
    algorithms = {cell.policy: cell for cell in cells if cell.trains}
    drive = {name: _measure_env(cfg, cell) for name, cell in scenarios.items()}
    learn = {name: _measure_learner(cfg, cell) for name, cell in algorithms.items()}
    seconds = {}
    for cell in cells:
        frames, played = _frames(cfg, cell, suites)
        think, update = learn.get(cell.policy, (0.0, 0.0))
        step, build = drive[cell.scenario]
        seconds[cell] = frames * (step + think + update) + played * (step + think)
        seconds[cell] += OVERHEAD + build * (1 + cell.trains)
    details = [f"{name} {1000 * step:.1f} ms" for name, (step, _) in drive.items()]
    details += [f"{name} + {1000 * sum(costs):.0f} ms" for name, costs in learn.items()]
    return Estimate(seconds, workers, details=[f"{', '.join(details)} a macro step of a team"])


def _frames(cfg: BenchmarkSettings, cell: Cell, suites: int) -> tuple[int, int]:
    """(macro steps of teams trained, at most played)."""
    length = episode_decisions(cfg.scenario, find_scenario(cell.scenario)) or UNKNOWN_LENGTH
    frames = length_of(cfg, cell).get("total_frames", cfg.total_frames)
    if cfg.together:  # each scenario has its share of the one training
        frames //= len(as_list(cfg.scenarios))
    return (frames if cell.trains else 0), cfg.episodes * suites * length


def _volume(cfg: BenchmarkSettings, cell: Cell, suites: int) -> float:
    frames, played = _frames(cfg, cell, suites)
    return PLAIN * (10 * frames + played) / 1000 + OVERHEAD


def _measure_env(cfg: BenchmarkSettings, cell: Cell) -> tuple[float, float]:
    """(seconds a macro step of a team under a classical policy takes, seconds building the env takes)."""
    settings, _ = cell_config(cfg, cell)
    with blame_input():
        maps = load_maps(settings.scenario, train=False).held_out
        size, begin = min(cfg.num_envs, cfg.episodes), time.perf_counter()
        env = make_env(settings, maps[:1], cfg.num_robots, size)
        build = (time.perf_counter() - begin) * len(maps)
        policy = POLICIES["nearest_frontier"](env)
    state = step_mdp(env.step(policy(env.reset())))  # compiles and warms up
    lap = _time(lambda: env.step(policy(state)))
    return lap / size, build


def _measure_learner(cfg: BenchmarkSettings, cell: Cell) -> tuple[float, float]:
    """(seconds the policy takes for a team, seconds an update takes per macro step of a team)."""
    settings, _ = cell_config(cfg, cell)
    if find_scenario(cell.scenario).build is not None:
        settings.scenario.maps = [0]
        settings.scenario.held_out, settings.scenario.held_out_count = [0], None
    with blame_input():
        env = make_env(settings, load_maps(settings.scenario).train, settings.num_robots)
        learner = make_learner(settings, env)
    steps = min(set_steps(settings, env), math.ceil(FRAMES / settings.num_envs))
    with torch.no_grad():
        batch = env.rollout(steps, learner.policy, break_when_any_done=False)
        think = _time(lambda: learner.policy(batch[:, 0].clone())) / settings.num_envs
    update = _time(lambda: learner.updater.update(batch.clone(), progress=0.0)) / batch.numel()
    return think, update


def _time(do: Callable[[], Any]) -> float:
    """Seconds that something takes, once warm."""
    seconds = _time_once(do)
    return _time_once(do) if seconds < QUICK else seconds


def _time_once(do: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    do()
    return time.perf_counter() - begin
