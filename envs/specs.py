"""Shapes, types and bounds of what enters and leaves the env (docs/concepts.md, Keys of the tensordict)."""

import torch
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded

from maexp.envs.config import EnvSettings
from maexp.envs.targets.features import feature_names
from maexp.kernels.observe import picture_shapes
from maexp.kernels.reward import MARKS, REWARD_TERMS
from maexp.kernels.types import REGIONS

INFO_ENV = {
    "coverage": torch.float32,
    "coverage_auc": torch.float32,
    **{f"coverage_step_{mark}": torch.int32 for mark in MARKS},
    **{f"mutual_overlap_{mark}": torch.float32 for mark in MARKS},
    "local_steps": torch.int32,
}
"""Entries of ``info`` of shape [E, 1]. ``coverage_auc``: mean coverage over the local steps of a full episode, as if
nothing more were seen from now on."""

INFO_ROBOT = {
    **{f"reward_{term}": torch.float32 for term in REWARD_TERMS},
    "collided": torch.bool,
    "path_length": torch.float32,
    **{f"path_length_{mark}": torch.float32 for mark in MARKS},
    "episode_reward": torch.float32,
    "episode_reward_unscaled": torch.float32,
}
"""Entries of ``info`` of shape [E, N]; ``episode_reward_unscaled`` is the sum of terms before scaling by w and v."""


INFO_RADIO = {
    "worst_coverage": torch.float32,
    "worst_coverage_auc": torch.float32,
    "told_step_95": torch.int32,
    "bytes_sent": torch.int64,
}
"""Entries of shape [E, 1] where communication is limited: of the robot that knows least at each moment, the local step
after which all radios knew 95 %, and what radios have sent."""
INFO_BASE = {"base_coverage": torch.float32, "base_coverage_auc": torch.float32}
"""The same where there is a base station."""
INFO_COUNTED = {"counted_coverage": torch.float32}
"""The same where not what the team has seen ends an episode: what does."""
INFO_MAPS = {"map_error": torch.float32}
"""The same where maps have errors: how far known ground is from where it is drawn [m]."""
OF_TEAM = INFO_ENV | INFO_RADIO | INFO_BASE | INFO_COUNTED | INFO_MAPS


def info_shapes(settings: EnvSettings) -> tuple[dict[str, torch.dtype], dict[str, torch.dtype]]:
    """Entries of ``info`` of shape [E, 1] and [E, N]."""
    team, robot = dict(INFO_ENV), dict(INFO_ROBOT)
    if settings.limited:
        base, counted = settings.comm.has_base, settings.done != "union"
        team |= INFO_RADIO | (INFO_BASE if base else {}) | (INFO_COUNTED if counted else {})
        robot["connected"] = torch.float32
    if settings.faults.enabled:
        robot["failed"] = torch.bool
    if settings.odometry.enabled:
        robot["odometry_error"] = torch.float32
    if settings.odometry.map_errors:
        team |= INFO_MAPS
    return team, robot


def observation_spec(
    envs: int,
    robots: int,
    device: torch.device,
    info: tuple[dict[str, torch.dtype], dict[str, torch.dtype]],
    pictures: bool = True,
    targets: int = 0,
    radio: bool = False,
    dims: int = 2,
) -> Composite:
    """Observation of every robot, with so many targets to choose from that tell of radios or not, the team's map, and
    `info_shapes`; in a volume (3 ``dims``) without regions."""
    (pictured, merged), regions = picture_shapes(envs, robots), REGIONS

    def picture(shape):
        # Unbounded is all of uint8, 0 to 255; `Bounded` would compare its bounds in float64, pixel by pixel.
        return Unbounded(shape=shape, dtype=torch.uint8, device=device)

    def real(*shape):
        return Unbounded(shape=shape, dtype=torch.float32, device=device)

    own = {"map": picture(pictured)} if pictures else {}
    own["pose"] = real(envs, robots, 2 + dims)
    if dims == 2:
        own["grid"] = real(envs, robots, 4, regions, regions)
    team = {"team": Composite(map=picture(merged), shape=(envs,), device=device)} if pictures else {}
    observation = Composite(
        **own,
        comm=Binary(robots, shape=(envs, robots, robots), dtype=torch.bool, device=device),
        time_left=Bounded(0.0, 1.0, shape=(envs, robots, 1), dtype=torch.float32, device=device),
        alive=Binary(robots, shape=(envs, robots), dtype=torch.bool, device=device),
        shape=(envs, robots),
        device=device,
    )
    if targets:
        observation["targets"] = real(envs, robots, targets, len(feature_names(radio)))
        mask = (envs, robots, targets)
        observation["targets_mask"] = Binary(targets, shape=mask, dtype=torch.bool, device=device)
    told = {name: _value((envs, 1), dtype, device) for name, dtype in info[0].items()}
    told |= {name: _value((envs, robots), dtype, device) for name, dtype in info[1].items()}
    return Composite(
        agents=Composite(observation=observation, shape=(envs, robots), device=device),
        **team,
        info=Composite(told, shape=(envs,), device=device),
        shape=(envs,),
        device=device,
    )


def _value(shape, dtype, device):
    if dtype == torch.bool:
        return Binary(shape[-1], shape=shape, dtype=dtype, device=device)
    return Unbounded(shape=shape, dtype=dtype, device=device)


def action_spec(
    envs: int, robots: int, direct: bool, device: torch.device, targets: int = 0, dims: int = 2
) -> Composite:
    """Which target every robot takes, where it is shown some; else region and offset of its goal, in a volume the goal
    itself, or its controls where the planner is ``direct``."""
    if direct:
        action = {"control": Bounded(-1.0, 1.0, shape=(envs, robots, 2), dtype=torch.float32, device=device)}
    elif targets:
        action = {"target": Categorical(targets, shape=(envs, robots), dtype=torch.int64, device=device)}
    elif dims == 3:
        action = {"goal": Unbounded(shape=(envs, robots, dims), dtype=torch.float32, device=device)}
    else:
        action = {
            "region": Categorical(REGIONS**2, shape=(envs, robots), dtype=torch.int64, device=device),
            "offset": Bounded(-1.0, 1.0, shape=(envs, robots, 2), dtype=torch.float32, device=device),
        }
    inner = Composite(action, shape=(envs, robots), device=device)
    group = Composite(action=inner, shape=(envs, robots), device=device)
    return Composite(agents=group, shape=(envs,), device=device)


def reward_spec(envs: int, robots: int, device: torch.device) -> Composite:
    """One reward per robot."""
    reward = Unbounded(shape=(envs, robots, 1), dtype=torch.float32, device=device)
    group = Composite(reward=reward, shape=(envs, robots), device=device)
    return Composite(agents=group, shape=(envs,), device=device)


def done_spec(envs: int, device: torch.device) -> Composite:
    """Termination (success, all collided) apart from truncation (out of macro steps)."""
    flags = {
        name: Categorical(2, shape=(envs, 1), dtype=torch.bool, device=device)
        for name in ("done", "terminated", "truncated")
    }
    return Composite(flags, shape=(envs,), device=device)
