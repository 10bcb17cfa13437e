"""Warm start: before it learns from rewards, a policy learns to act like another one.

The teacher acts, any policy that takes the same env: the policy learns by supervision to give its actions a high
probability, and the critic what they earn. Each batch is looked at a few times and forgotten, so that memory does
not grow. Afterwards the algorithm may keep the policy near what it has become (`algorithm.anchor_coeff`).
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.modules import ProbabilisticActor

from maexp.agents.algorithms.losses import check_finite
from maexp.agents.algorithms.updaters import Meter
from maexp.agents.build import Learner, choose_device, make_env
from maexp.agents.errors import UserError, blame_input
from maexp.agents.files import write_text
from maexp.agents.networks.actor import ALIVE
from maexp.agents.policies.classical import POLICIES
from maexp.agents.policies.load import is_exported, load_policy_folder, show_targets
from maexp.agents.progress import Progress
from maexp.agents.runtime.shipped import advise, shipped_names
from maexp.agents.settings.checks import check_counts, check_goals
from maexp.agents.settings.compose import settings_of
from maexp.agents.settings.model import SIZES, ModelConfig
from maexp.agents.settings.resolved import model_settings
from maexp.agents.settings.schema import TrainSettings
from maexp.agents.training.checkpoint import find_checkpoint, restore_policy
from maexp.agents.training.collect import batch_statistics, divide_teams
from maexp.agents.training.train import TrainingRun, check_action
from maexp.envs import ExplorationEnv

LEARNING_RATE = 2e-3
PASSES = 4  # over each batch
LOG = "warm_start.csv"


def check_warm_start(cfg: TrainSettings) -> None:
    """Raise UserError for a teacher or a count that cannot be used."""
    check_counts(cfg, "warm_start_frames")
    if cfg.warm_start in POLICIES:
        check_goals([cfg.warm_start], cfg.planner.name)
        _check_kind(cfg, "regions")
    elif cfg.warm_start is not None and is_exported(cfg.warm_start):
        _check_kind(cfg, "targets")
        show_targets(cfg, [cfg.warm_start], "warm_start")
    elif cfg.warm_start is not None and not Path(cfg.warm_start).exists():
        names = [*POLICIES, *shipped_names()]
        raise UserError(
            f"warm_start={cfg.warm_start} is neither a run's folder, a checkpoint, nor a policy: "
            f"{advise(cfg.warm_start, names)}".rstrip("?") + "."
        )


def _check_kind(cfg: TrainSettings, taught: str) -> None:
    """Raise UserError where the teacher chooses something else than the policy that is to imitate it."""
    chosen = model_settings(cfg).action
    if chosen != taught:
        raise UserError(
            f"warm_start={cfg.warm_start} chooses {taught}, which a policy with action={chosen} cannot imitate: "
            f"add action={taught}."
        )


def load_teacher(cfg: TrainSettings, env: ExplorationEnv) -> TensorDictModuleBase:
    """The policy to imitate in `env`."""
    if cfg.warm_start in POLICIES:
        return POLICIES[cfg.warm_start](env)
    if is_exported(cfg.warm_start):
        return load_policy_folder(cfg.warm_start, env, "warm_start")
    _, saved = find_checkpoint(cfg.warm_start)
    check_action(saved, cfg)
    _check_kind(cfg, model_of(saved).action)
    return restore_policy(env, model_of(saved), saved)


def model_of(saved: dict) -> ModelConfig:
    """The sizes of the networks in a checkpoint."""
    values = {
        name.removeprefix("model."): value
        for name, value in settings_of(saved).items()
        if name.startswith("model.") and value is not None
    }
    return replace(SIZES[values.pop("preset", "small")], **values)


def warm_start(run: TrainingRun) -> None:
    """Let the policy and critic of a `TrainingRun` that has not begun imitate; the log is `warm_start.csv`."""
    cfg, updater = run.cfg, run.learner.updater
    optimizer = torch.optim.Adam(run.learner.policy.parameters(), lr=LEARNING_RATE, eps=1e-5)
    rounds, rows = math.ceil(cfg.warm_start_frames / run.batch_frames), []
    with Progress(f"imitating {cfg.warm_start}", rounds * run.batch_frames) as progress:
        for number, batches in enumerate(demonstrate(run, rounds), start=1):
            meter = Meter()
            steps = [updater.prepare(batch) for batch in batches]
            for _ in range(PASSES):
                imitate(run.learner, optimizer, steps, meter)
                updater.learn_values(steps, meter)
            row = {"frames": number * run.batch_frames, "coverage": batch_statistics(*batches)["coverage"]}
            rows.append(row | meter.means())
            progress.show(row["frames"], f"negative log-likelihood {rows[-1]['nll']:.2f}")
    lines = [",".join(rows[0]), *(",".join(f"{value:.6g}" for value in row.values()) for row in rows)]
    write_text(run.folder / LOG, "\n".join(lines) + "\n")
    updater.set_anchor()
    run.experience.update_policy_weights_()


def demonstrate(run: TrainingRun, rounds: int) -> Iterator[list[TensorDictBase]]:
    """Batches [envs, steps] of every team size in which the teacher acts, from the start of episodes on."""
    cfg, device = run.cfg, choose_device(run.cfg, "train_device")
    with blame_input():
        envs = [
            make_env(cfg, run.suite.train, one.num_robots, one.num_envs, device=device)
            for one in divide_teams(cfg.num_envs, run.sizes)
        ]
        teachers = [load_teacher(cfg, env) for env in envs]
    for _ in range(rounds):
        with torch.no_grad():
            batches = [
                env.rollout(cfg.collector.steps, teacher, break_when_any_done=False)
                for env, teacher in zip(envs, teachers, strict=True)
            ]
        yield batches


def imitate(learner: Learner, optimizer: torch.optim.Optimizer, steps: list[TensorDictBase], meter: Meter) -> None:
    """One pass over the team steps: make what the teacher's living robots did more likely."""
    policy, updater = learner.policy, learner.updater
    for parts in updater.minibatches(steps, updater.settings.minibatch_size):
        heads = [negative_log_likelihood(policy, part) for part in parts]
        mean = {name: sum(one[name] for one in heads) / len(heads) for name in heads[0]}
        loss = sum(mean.values())
        check_finite("the negative log-likelihood", loss)
        optimizer.zero_grad()
        loss.backward()
        updater.clip(list(policy.parameters()), "policy")
        optimizer.step()
        meter.add({"nll": loss.item()} | {f"nll_{name}": value.item() for name, value in mean.items()})


def negative_log_likelihood(policy: ProbabilisticActor, steps: TensorDictBase) -> dict[str, torch.Tensor]:
    """Of the actions in `steps`, by the name of the head; mean over the robots that had not collided."""
    log_probs = policy.get_dist(steps.select(*policy.in_keys)).log_prob(steps)
    alive = steps.get(ALIVE, None)
    alive = slice(None) if alive is None else alive
    return {
        key[-1].removesuffix("_log_prob"): -value[alive].mean()
        for key, value in log_probs.items(include_nested=True, leaves_only=True)
    }
