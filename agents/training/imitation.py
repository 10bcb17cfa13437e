"""Warm start: before it learns from rewards, a policy learns to act like another one.

The teacher acts, any policy that takes the same env: the policy learns by supervision to give its actions a high
probability, and the critic what they earn. Each batch is looked at a few times and forgotten, so that memory does
not grow. A teacher whose network is the policy's gives it its weights; only the critic has to learn then. Afterwards
the algorithm may keep the policy near what it has become (`algorithm.anchor_coeff`).
"""

import copy
import math
from collections.abc import Iterator

import torch
from tensordict import TensorDictBase
from torchrl.modules import ProbabilisticActor

from maexp.agents.algorithms.losses import check_finite
from maexp.agents.algorithms.updaters import Meter
from maexp.agents.build import Learner, choose_device, make_env
from maexp.agents.config.verbs import TrainSettings
from maexp.agents.errors import UserError, blame_input
from maexp.agents.files import write_text
from maexp.agents.models.actor import ALIVE, load_matching
from maexp.agents.models.distributions import ACTION
from maexp.agents.policies.registry import NamedPolicy, check_planner, find_named_policy, suit_observation
from maexp.agents.progress import Progress
from maexp.agents.training.collectors import batch_statistics, divide_teams
from maexp.agents.training.train import TrainingRun

LEARNING_RATE = 2e-3
PASSES = 4  # over each batch
LOG = "warm_start.csv"
HEADS = ("region", "offset", "target", "goal", "control")


def check_warm_start(cfg: TrainSettings) -> None:
    """Raise UserError for a teacher that cannot be used."""
    if cfg.warm_start is None:
        return
    teacher = find_named_policy(cfg.warm_start, "warm_start")
    check_planner(cfg.planner.name, [teacher])
    suit_observation(copy.deepcopy(cfg), [teacher])
    _check_kind(cfg, taught_by(teacher))


def starts_as(spec: str | None) -> list[str]:
    """Overrides by which a policy starts from the planner that its teacher starts from, to take its weights; none
    where the teacher has no such network, or is none (`check_warm_start` says so)."""
    try:
        model = None if spec is None else find_named_policy(spec, "warm_start").model
    except UserError:
        return []
    return [] if model is None else [f"model.starts_from={model.starts_from}"]


def taught_by(teacher: NamedPolicy) -> str | None:
    """What a policy chooses; None: it tells when it acts."""
    if teacher.direct:
        return "controls"
    if teacher.kind == "own" and teacher.direct is None:
        return None
    return "targets" if teacher.targets is not None else "regions"


def _check_kind(cfg: TrainSettings, taught: str | None) -> None:
    """Raise UserError where the teacher chooses something else than the policy that is to imitate it."""
    chosen = "controls" if cfg.planner.name == "direct" else cfg.model.action
    if taught not in (None, chosen):
        raise UserError(
            f"warm_start={cfg.warm_start} chooses {taught}, which a policy with action={chosen} cannot imitate: "
            f"add action={taught}."
        )


def warm_start(run: TrainingRun) -> None:
    """Let the policy and critic of a `TrainingRun` that has not begun imitate; the log is `warm_start.csv`."""
    cfg, updater = run.cfg, run.learner.updater
    taken = take_weights(run)
    if taken:
        print(f"The policy begins with the weights of {cfg.warm_start}.", flush=True)
    if taken and not updater.uses_critic:
        run.experience.update_policy_weights_()
        return
    optimizer = torch.optim.Adam(run.learner.policy.parameters(), lr=LEARNING_RATE, eps=1e-5)
    rounds, rows = math.ceil(cfg.warm_start_frames / run.batch_frames), []
    with Progress(f"{'watching' if taken else 'imitating'} {cfg.warm_start}", rounds * run.batch_frames) as progress:
        for number, batches in enumerate(demonstrate(run, rounds), start=1):
            meter = Meter()
            steps = [updater.prepare(batch) for batch in batches]
            for _ in range(PASSES):
                if not taken:
                    imitate(run.learner, optimizer, steps, meter)
                updater.learn_values(steps, meter)
            row = {"frames": number * run.batch_frames, "coverage": batch_statistics(*batches)["coverage"]}
            rows.append(row | meter.means())
            progress.show(row["frames"], "" if taken else f"negative log-likelihood {rows[-1]['nll']:.2f}")
    lines = [",".join(rows[0]), *(",".join(f"{value:.6g}" for value in row.values()) for row in rows)]
    write_text(run.folder / LOG, "\n".join(lines) + "\n")
    updater.set_anchor()
    run.experience.update_policy_weights_()


def take_weights(run: TrainingRun) -> bool:
    """Give the policy of `run` its teacher's weights, where both have the same network; else False."""
    cfg = run.cfg
    teacher = find_named_policy(cfg.warm_start, "warm_start")
    if teacher.model is None or teacher.model.policy != cfg.model.policy:
        return False
    with blame_input():
        env = make_env(cfg, run.suite.train[:1], run.sizes[0], 1, device=choose_device(cfg, "train_device"))
        own = run.learner.policy
        load_matching(own, widened(teacher.make(env).state_dict(), own.state_dict()))
    return True


def widened(state: dict[str, torch.Tensor], like: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Weights of a policy that is told nothing of radios for one that is: the inputs that it has besides weigh 0."""

    def widen(tensor: torch.Tensor, more: int) -> torch.Tensor:
        return torch.nn.functional.pad(tensor, (0, more)) if more > 0 else tensor

    return {
        name: widen(tensor, like[name].shape[-1] - tensor.shape[-1]) if tensor.dim() == 2 else tensor
        for name, tensor in state.items()
    }


def demonstrate(run: TrainingRun, rounds: int) -> Iterator[list[TensorDictBase]]:
    """Batches [envs, steps] of every team size in which the teacher acts, from the start of episodes on."""
    cfg, device = run.cfg, choose_device(run.cfg, "train_device")
    with blame_input():
        envs = [
            make_env(cfg, run.suite.train, team.num_robots, team.num_envs, device=device)
            for team in divide_teams(cfg.num_envs, run.sizes)
        ]
        teacher = find_named_policy(cfg.warm_start, "warm_start")
        teachers = [teacher.make(env) for env in envs]
    for _ in range(rounds):
        with torch.no_grad():
            batches = [
                env.rollout(cfg.collector.steps, teacher, break_when_any_done=False)
                for env, teacher in zip(envs, teachers, strict=True)
            ]
        _check_heads(cfg, run.learner.policy, batches[0])
        yield batches


def _check_heads(cfg: TrainSettings, policy: ProbabilisticActor, batch: TensorDictBase) -> None:
    """Raise UserError where the teacher acted by other means than the policy that is to imitate it."""
    wanted = [head for head in HEADS if (*ACTION, head) in policy.out_keys]
    chosen = [head for head in HEADS if head in batch["agents", "action"].keys()]
    if not {*wanted} <= {*chosen}:
        raise UserError(
            f"warm_start={cfg.warm_start} wrote {' and '.join(chosen)}, and the policy that is to imitate it "
            f"chooses {' and '.join(wanted)}: let it write that, or set action."
        )


def imitate(learner: Learner, optimizer: torch.optim.Optimizer, steps: list[TensorDictBase], meter: Meter) -> None:
    """One pass over the team steps: make what the teacher's living robots did more likely."""
    policy, updater = learner.policy, learner.updater
    for parts in updater.minibatches(steps, updater.settings.minibatch_size):
        heads = [negative_log_likelihood(policy, part) for part in parts]
        mean = {name: sum(head[name] for head in heads) / len(heads) for name in heads[0]}
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
