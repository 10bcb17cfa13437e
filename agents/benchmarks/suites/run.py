"""A run of a suite: every part batch by batch, each kept as soon as it is done, then the score."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maexp.agents.benchmarks.suites import run_files
from maexp.agents.benchmarks.suites.frozen import check_maps, play_rivals, read_frozen, sums
from maexp.agents.benchmarks.suites.play import Batch, SuitePolicy, build_env, build_maps, play_batch
from maexp.agents.benchmarks.suites.score import summarise_suite
from maexp.agents.benchmarks.suites.suite import Suite
from maexp.agents.errors import UserError, blame_input


@dataclass
class SuiteRun:
    """What is played.

    Attributes:
        seed: None: the suite's own maps and starts
        num_envs: teams at once
        device: of the simulation
        advance: called with the number of episodes that are done
        tell: called with a sentence when an episode ends early for the first time
    """

    suite: Suite
    policy: SuitePolicy
    where: Path
    seed: int | None
    num_envs: int
    device: Any
    advance: Callable[[int], None] = lambda count: None
    tell: Callable[[str], None] = lambda sentence: None
    told: bool = field(default=False, init=False)

    def play(self) -> dict[str, Any]:
        """Play what is left, write `results.json`, and return its content."""
        begin = time.perf_counter()
        batches, points = {}, {}
        for name in self.suite.parts:
            batches[name], points[name] = self._play_part(name)
        with blame_input():
            rivals = read_frozen(self.suite) if self.seed is None else play_rivals(self.suite, self.seed)["results"]
        summary = summarise_suite(self.suite, run_files.to_results(self.policy.name, self.suite, batches), rivals)
        code = run_files.describe_code()
        content = {
            "format": run_files.FORMAT,
            "suite": run_files.describe_suite(self.suite, self.seed),
            "policy": self.policy.name,
            **summary,
            "decisions": run_files.describe_decisions(batches),
            "episodes": run_files.describe_episodes(self.suite, batches),
            "maps": points,
            "files": run_files.list_files(self.where),
            "run": {
                "policy": self.policy.spec,
                **code,
                "machine": run_files.describe_machine(),
                "device": str(self.device),
                "seconds": round(time.perf_counter() - begin, 1),
            },
        }
        run_files.write_results(self.where, content)
        return content

    def _play_part(self, name: str) -> tuple[list[Batch], dict[str, str]]:
        """The batches of a part, and the checksums of its maps."""
        suite, part = self.suite, self.suite.parts[name]
        with blame_input():
            maps = build_maps(part, self.seed)
            if self.seed is None or part.fetched:
                check_maps(suite, part, maps)
        size = min(self.num_envs, suite.episodes)
        played, env = [], None
        with ExitStack() as stack:
            for first in range(0, suite.episodes, size):
                if run_files.batch_file(self.where, name, first).exists():
                    played.append(self._read(name, first))
                else:
                    if env is None:
                        with blame_input():
                            env = build_env(
                                part, maps, size, suite.key(self.seed), self.policy.observation(), device=self.device
                            )
                            policy = stack.enter_context(self.policy.open(env))
                    played.append(play_batch(suite, env, policy, first))
                    run_files.write_batch(self.where, suite, name, played[-1])
                    self._tell_lost(name, played[-1])
                self.advance(len(played[-1].decisions))
        return played, sums(part, maps, self.seed)

    def _tell_lost(self, part: str, batch: Batch) -> None:
        lost = [k for k, reason in enumerate(batch.reasons.tolist()) if reason]
        if lost and not self.told:
            self.told = True
            self.tell(f"{part}, episode {batch.first + lost[0]} ended early: {batch.reasons[lost[0]]}.")

    def _read(self, name: str, first: int) -> Batch:
        """A batch that was played before."""
        try:
            return run_files.read_batch(self.where, self.suite, name, first)
        except UserError as error:
            raise UserError(f"{str(error).rstrip('.')}: remove it, and it is played again.") from error
