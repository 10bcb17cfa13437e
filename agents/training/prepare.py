"""Before a training: settings that go together, the networks, and what gathers their experience."""

from tensordict.nn import TensorDictModuleBase

from maexp.agents.build import (
    Learner,
    choose_device,
    load_maps,
    make_env,
    make_learner,
    other_scenarios,
    set_steps,
)
from maexp.agents.config.algorithms import ExpertSettings
from maexp.agents.config.checks import team_sizes
from maexp.agents.config.env import algorithm_settings
from maexp.agents.config.groups import CollectorSettings
from maexp.agents.config.verbs import TrainSettings
from maexp.agents.errors import UserError
from maexp.agents.memory import check_batch_memory
from maexp.agents.training.collectors import Experience, divide_teams, make_collector
from maexp.envs import ExplorationEnv, PointCloudMap

BACKENDS = ("single", "processes", "ray")


def make_both(cfg: TrainSettings, maps: list[PointCloudMap]) -> tuple[Learner, Experience]:
    """The networks that learn and what gathers their experience, each on its device.

    Args:
        cfg: the settings
        maps: those of the first scenario

    Raises:
        UserError, ValueError: settings that cannot be used.
    """
    check_collector(cfg.collector)
    alone, workers = cfg.collector.backend == "single", cfg.collector.workers
    here, there = choose_device(cfg, "sample_device"), choose_device(cfg, "train_device")
    others = other_scenarios(cfg)
    if others and not alone:
        raise UserError(f"scenario.also={list(cfg.scenario.also)} needs collector=single.")
    places = [(cfg, maps), *((other, load_maps(other.scenario).train) for other in others)]
    sizes = team_sizes(cfg.num_robots)
    teams = divide_teams(cfg.num_envs, sizes * len(places), workers)
    whole = "collector.steps" in cfg.followers  # episodes, which differ in length from scenario to scenario
    envs = [
        make_env(
            *places[k // len(sizes)],
            team.num_robots,
            team.num_envs if alone else 1,
            device=here if alone else there,
            first_env=team.first_env,
        )
        for k, team in enumerate(teams)
    ]
    set_steps(cfg, envs[0])
    steps = [env.macro_steps if whole else cfg.collector.steps for env in envs]
    for env, team, length in zip(envs, teams, steps, strict=True):
        check_batch_memory(env, length, team.num_envs)
    like = envs[0] if envs[0].device == there else make_env(cfg, maps[:1], teams[0].num_robots, 1, device=there)
    learner = make_learner(cfg, like)
    if alone:
        actors = [make_actor(cfg, learner.policy, env) for env in envs]
        pairs = zip(envs, actors, steps, strict=True)
        return learner, Experience([make_collector(env, actor, length, there) for env, actor, length in pairs])
    from maexp.agents.training.workers import make_workers  # here: most runs have none

    return learner, make_workers(cfg, maps, teams, learner.policy)


def make_actor(cfg: TrainSettings, policy: TensorDictModuleBase, env: ExplorationEnv) -> TensorDictModuleBase:
    """What acts in the training episodes of an env: the policy, with what the algorithm does besides."""
    settings = algorithm_settings(cfg)
    if not isinstance(settings, ExpertSettings):
        return policy
    from maexp.agents.training.branch_rollouts import BranchingActor  # builds on the planners

    return BranchingActor(policy, env, settings)


def check_expert(cfg: TrainSettings) -> None:
    """Raise UserError for settings that expert iteration cannot work with."""
    if cfg.algorithm.name != "expert_iteration":
        return
    if cfg.model.action != "targets" or cfg.planner.name == "direct":
        raise UserError("algorithm=expert_iteration learns what targets are worth: it needs action=targets.")
    if cfg.scenario.decide == "arrival":
        raise UserError(
            "scenario.decide=arrival: algorithm=expert_iteration branches at decisions of whole teams. Add "
            "algorithm=mappo, or leave that out."
        )
    if cfg.tuning == "reference":
        raise UserError("tuning=reference: the original platform has no algorithm=expert_iteration. Leave tuning out.")
    if cfg.collector.backend != "single":
        raise UserError(
            f"algorithm=expert_iteration plays its branches where it acts: it needs collector=single, not "
            f"collector={cfg.collector.backend}."
        )


def check_collector(settings: CollectorSettings) -> None:
    """Raise UserError for settings of `collector` that do not go together."""
    if settings.backend not in BACKENDS:
        raise UserError(f"collector.backend={settings.backend} is unknown: choose one of {', '.join(BACKENDS)}.")
    if settings.backend == "single":
        for name, default in (("workers", 1), ("overlap", False)):
            if getattr(settings, name) != default:
                raise UserError(
                    f"collector.{name}={getattr(settings, name)} needs collector=processes or collector=ray."
                )
    if settings.ray_address is not None and settings.backend != "ray":
        raise UserError(f"collector.ray_address={settings.ray_address} needs collector=ray.")


def describe_teams(cfg: TrainSettings) -> str:
    """The settings that choose a run's teams, as they are written on the command line."""
    return f"num_envs={cfg.num_envs} num_robots={','.join(map(str, team_sizes(cfg.num_robots)))}"


def describe_workers(cfg: TrainSettings) -> str:
    """Which processes simulate, for messages and to tell whether a checkpoint's state fits."""
    workers, backend = cfg.collector.workers, cfg.collector.backend
    if backend == "single":
        return "one process"
    single, several = {"processes": ("worker process", "worker processes"), "ray": ("Ray worker", "Ray workers")}[
        backend
    ]
    return f"{workers} {single if workers == 1 else several}{', one batch ahead' * cfg.collector.overlap}"
