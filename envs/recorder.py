"""Coverage over time and each robot's share of the exploration, recorded while any code plays an env."""

import numpy as np

from maexp.kernels.constants import DT


class CoverageRecorder:
    """Records the coverage of every team while the env is used in the ``with`` block::

        with CoverageRecorder(env, every=5) as recorder:
            evaluate(policy, env, episodes)
        seconds, coverage = recorder.curves(episodes)

    Expects full resets, as evaluation makes them: each starts a batch of ``num_envs`` episodes; a team that is
    done keeps its coverage. Takes the env's step hook, so no film can be made at the same time.

    Args:
        env: an :class:`ExplorationEnv`.
        every: local steps from one record to the next.
    """

    def __init__(self, env, every: int = 5):
        self.env, self.every = env, every
        self._batches: list[dict] = []

    def __enter__(self) -> "CoverageRecorder":
        self.env.set_step_hook(self._record, every=self.every)
        return self

    def __exit__(self, *error) -> None:
        self.env.set_step_hook(None)

    def _record(self, env) -> None:
        state, totals = env.simulation.tensors, env.simulation.map_tensors["total_weight"]
        step = int(state["local_step"].max())
        if step == 0:
            self._batches.append({"step": [], "coverage": []})
        if env.arrivals is not None:  # teams are at moments of their own
            step = state["local_step"].cpu().numpy().copy()
        if not self._batches:
            return  # the block began in the middle of an episode: it has no start to count from
        batch = self._batches[-1]
        if batch["step"] and np.array_equal(step, batch["step"][-1]):
            return  # every team is done and stands still
        batch["step"].append(step)
        batch["coverage"].append((state["covered"] / totals[state["map_id"].long()]).cpu().numpy())
        batch["explored"] = state["unscaled"][:, :, 0].cpu().numpy().copy()

    def batch(self) -> dict[str, np.ndarray]:
        """What was recorded of the last batch of episodes, to keep and `add`."""
        return {name: np.array(values) for name, values in self._batches[-1].items()}

    def add(self, batch: dict[str, np.ndarray]) -> None:
        """Take over a batch that was recorded before, in place of playing it."""
        self._batches.append(batch)

    def curves(self, episodes: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Times [s], shape (records,), and coverage (episodes, records) of the first ``episodes`` episodes.

        Raises:
            ValueError: nothing was recorded.
        """
        self._check()
        times = np.unique(np.concatenate([np.array(batch["step"]) for batch in self._batches]))
        coverage = []
        for batch in self._batches:
            curves, steps = np.stack(batch["coverage"], axis=1), np.array(batch["step"])
            of_team = list(steps.T) if steps.ndim > 1 else [steps] * len(curves)
            coverage.append(np.stack([np.interp(times, *pair) for pair in zip(of_team, curves, strict=True)]))
        return times * DT, np.concatenate(coverage)[:episodes]

    def contributions(self, episodes: int | None = None) -> np.ndarray:
        """Share of each robot in what its team discovered, (episodes, robots), rows sum to 1 (or 0: nothing new)."""
        self._check()
        explored = np.concatenate([batch["explored"] for batch in self._batches])[:episodes].astype(np.float64)
        total = explored.sum(axis=1, keepdims=True)
        return np.divide(explored, total, out=np.zeros_like(explored), where=total > 0)

    def _check(self) -> None:
        if not self._batches:
            raise ValueError("nothing was recorded; reset and step the env inside the `with` block")
