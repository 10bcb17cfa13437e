"""The TorchRL env: a batch of teams that explore point-cloud maps."""

from collections.abc import Callable, Sequence
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary
from torchrl.envs import EnvBase

from maexp.envs import plane
from maexp.envs.arrivals import Arrivals
from maexp.envs.comm.strategy import Strategy
from maexp.envs.config import (
    CELL_BYTES,
    STARTS,
    EnvSettings,
)
from maexp.envs.maps.map_batch import MapBank
from maexp.envs.maps.point_cloud import MapError, PointCloudMap
from maexp.envs.pickling import describe, rebuild
from maexp.envs.scenarios import Scenario, find_scenario
from maexp.envs.settings import positive_count
from maexp.envs.spawn import NO_ROOM
from maexp.envs.specs import REWARD_TERMS, action_spec, done_spec, info_shapes, observation_spec, reward_spec
from maexp.envs.targets.observation import TargetView, draw_targets
from maexp.envs.volume.map import VoxelMap
from maexp.kernels.reset import EVALUATION
from maexp.kernels.reward import MARKS
from maexp.kernels.types import ERROR_ACTION, ERROR_CAPACITY, ERROR_REGION, ERROR_START, ERRORS, REGIONS, ROOM_UNIT

PICTURES = (("agents", "observation", "map"), ("team", "map"))
"""Observations that are pictures."""


def _setting(name: str, meaning: str) -> property:
    """A read-only attribute of the env: a field of its `EnvSettings`."""
    return property(lambda env: getattr(env.settings, name), doc=meaning)


def find_space(maps: Sequence[PointCloudMap | VoxelMap]) -> ModuleType:
    """What an env does on maps of their kind: `maexp.envs.plane` or `maexp.envs.volume.space`."""
    voxels = [isinstance(m, VoxelMap) for m in maps]
    if any(voxels) and not all(voxels):
        raise ValueError("maps holds VoxelMaps and maps in the plane: give an env of its own to each kind")
    if not any(voxels):
        return plane
    from maexp.envs.volume import space  # whoever plays in the plane never loads it

    return space


class ExplorationEnv(EnvBase):
    """``num_envs`` teams of ``num_robots`` robots, each on one of ``maps``, chosen anew at every reset.

    Args:
        maps: one map or several, all in the plane (`PointCloudMap`) or all volumes (`VoxelMap`); they may differ in
            size.
        num_envs, num_robots, device, seed: the first fields of `maexp.envs.EnvSettings`.
        starts: "drawn" anew at every reset; "together": a place for the team is drawn at every reset, in which robots
            stand beside each other, as far from walls and from each other as always; "fixed": drawn once for each map,
            from (seed, map) alone, and kept; or poses, as for `set_starts`.
        settings: its other fields by name. What is None takes the value of the scenario of the first map; ``robot``
            and ``radar`` may be lists with one config per robot.

    Raises:
        ValueError: a setting is out of its range (named, with its value).
        MapError: a map has no room for the team.
    """

    batch_locked = True

    num_envs = _setting("num_envs", "Teams in the batch, E.")
    num_robots = _setting("num_robots", "Robots in a team, N.")
    local_steps = _setting("local_steps", "Control steps of 0.1 s in a macro step.")
    macro_steps = _setting("macro_steps", "Macro steps of an episode.")
    collision = _setting("collision", '"centre" or "footprint".')
    success_coverage = _setting("success_coverage", "Coverage that ends an episode.")
    robot_configs = _setting("robot", "One `RobotConfig` per robot.")
    radar_configs = _setting("radar", "One `RadarConfig` per robot.")
    planner_config = _setting("planner", "The `PlannerConfig`.")
    observation_config = _setting("observation", "The `ObservationConfig`.")
    comm_config = _setting("comm", "The `CommConfig`.")
    targets_config = _setting("targets", "The `TargetsConfig`.")
    lookahead_config = _setting("lookahead", "The `LookaheadConfig`.")

    @torch.inference_mode(False)  # made within it, the env is used outside, too
    def __init__(
        self,
        maps: PointCloudMap | VoxelMap | Sequence[PointCloudMap | VoxelMap],
        num_envs: int = 1,
        num_robots: int = 3,
        device: str | torch.device = "cpu",
        seed: int = 0,
        *,
        starts: str | np.ndarray | torch.Tensor = "drawn",
        **settings: Any,
    ):
        maps = [maps] if isinstance(maps, PointCloudMap | VoxelMap) else list(maps)
        space = find_space(maps)
        settings = space.complete_settings(EnvSettings(num_envs, num_robots, device, seed, **settings), maps)
        self._set_up(settings, space.prepare_maps(maps, settings), starts)

    @torch.inference_mode(False)
    def _set_up(self, settings: EnvSettings, bank: MapBank, starts: str | np.ndarray | torch.Tensor = "drawn") -> None:
        """Build everything of an env from its complete settings and its maps."""
        EnvBase.__init__(self, device=settings.device, batch_size=torch.Size([settings.num_envs]))
        self.settings, self.bank, self.maps, self.space = settings, bank, bank.maps, find_space(bank.maps)
        self.space.check_memory(settings, self.bank)
        together = isinstance(starts, str) and starts == "together"
        if together:
            self.space.check_together(self.bank, settings)
        self.simulation = self.space.build_simulation(settings, self.bank, together)
        self._hook: tuple[Callable, int] | None = None
        self.starts = starts if isinstance(starts, str) else "drawn"  # unless poses are given
        self._fix_starts()
        if not isinstance(starts, str):
            self.set_starts(starts)
        elif starts not in STARTS:
            raise ValueError(f"starts={starts!r} is unknown: choose {', '.join(STARTS)} or poses")
        self.arrivals = Arrivals(self) if settings.decide == "arrival" else None
        shown = settings.observation.targets
        acts = settings.comm.strategy != "opportunistic"
        self.strategy = Strategy(self) if acts or settings.observes_radios else None
        self.target_view = TargetView(self, shown) if shown else None
        if shown:  # of this object: where a class draws its own, TorchRL refuses transforms such as ActionMask
            self.rand_action = partial(draw_targets, super().rand_action)
        e, n = settings.num_envs, settings.num_robots
        info, pictures = info_shapes(settings), settings.observation.pictures
        info[0].update(self.space.INFO)
        shown, radio = (shown and self.target_view.shown), settings.observes_radios
        dims = self.space.DIMENSIONS
        self.observation_spec = observation_spec(e, n, self.device, info, pictures, shown, radio, dims)
        if self.arrivals is not None:
            deciding = Binary(n, shape=(e, n), dtype=torch.bool, device=self.device)
            self.observation_spec["agents", "deciding"] = deciding
        self.action_spec = action_spec(e, n, settings.planner.name == "direct", self.device, shown, dims)
        self.reward_spec = reward_spec(e, n, self.device)
        self.done_spec = done_spec(e, self.device)

    @property
    def scenario(self) -> Scenario:
        """Row of the table of scenarios that filled in what was not given."""
        return find_scenario(self.maps[0].scenario)

    # Reset and step

    @torch.inference_mode(False)
    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        state = self.simulation.tensors
        mask = torch.ones(self.num_envs, dtype=torch.int32, device=self.device)
        if tensordict is not None and "_reset" in tensordict.keys():
            mask = tensordict["_reset"].reshape(self.num_envs).to(torch.int32)
        state["episode"] += mask
        self.simulation.reset(mask)
        self._raise_errors()
        if self.arrivals is not None:
            self.arrivals.begin(mask)
        if self._hook is not None:
            self._hook[0](self)
        done = self._done()
        out = self.observe(mask)  # TorchRL takes the other envs' observation from what it had
        info = out["info"]
        for name in info.keys():  # info tells of the step just made; a new episode has made none
            keep = mask.reshape(-1, 1) == 0
            blank = -1 if "_step_" in name else 0
            info[name] = torch.where(keep, info[name], torch.full_like(info[name], blank))
        return out.update(done)

    def _reset_proc_data(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        """TorchRL's, but pictures of the teams that start anew are copied: its `where` over all takes far longer."""
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or self.device.type != "cpu" or bool(mask.all()):
            return super()._reset_proc_data(tensordict, tensordict_reset)
        rows, merged = mask.reshape(-1).nonzero().squeeze(-1), {}
        for key in PICTURES if self.observation_config.pictures else ():
            before, drawn = tensordict.pop(key, None), tensordict_reset.pop(key)
            # New tensors: the step that has ended keeps its own. Of the teams that go on, `drawn` is black.
            merged[key] = drawn if before is None else before.index_copy(0, rows, drawn[rows])
        return super()._reset_proc_data(tensordict, tensordict_reset).update(merged)

    @torch.inference_mode(False)
    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        state, sim = self.simulation.tensors, self.simulation
        running = state["active"].clone()
        self._take_action(tensordict["agents", "action"])
        sim.set_goals()
        if self.arrivals is not None:
            self.arrivals.play(None if self._hook is None else self._hook[0])
        elif self._hook is None:
            sim.step(0, self.local_steps)
        else:
            hook, every = self._hook
            for start in range(0, self.local_steps, every):
                sim.step(start, min(every, self.local_steps - start))
                hook(self)
        self._raise_errors()
        state["macro_step"] += running
        reward = state["terms"].sum(-1)
        state["episode_reward"] += reward
        done = self._done()
        state["active"] *= 1 - done["done"].reshape(-1).to(torch.int32)
        out = self.observe()
        out["agents", "reward"] = reward.unsqueeze(-1)
        return out.update(done)

    def _take_action(self, action: TensorDictBase) -> None:
        state = self.simulation.tensors
        if self.planner_config.name == "direct":
            control = action["control"]
            bad = ~torch.isfinite(control).flatten(1).all(1)
            state["error"] |= bad.to(torch.int32) * ERROR_ACTION
            state["command"].copy_(torch.nan_to_num(control))
        else:
            goals, tells = self._find_goals(action)
            goals = goals if self.strategy is None else self.strategy.direct(goals, tells)
            state["wanted"].copy_(goals if self.arrivals is None else self.arrivals.take(goals))

    def _find_goals(self, action: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Goals of the action, as the simulation takes them: by targets, or as the env's space has them; and who is to
        tell the base station."""
        if "target" not in action.keys():
            if self.target_view is not None:
                self.target_view.forget()
            return self.space.find_goals(self, action), None
        if self.target_view is None:
            raise ValueError("the action names targets and the env shows none: set observation.targets to how many")
        return self.target_view.take(action["target"], action.get("preference", None)), self.target_view.tells

    def _done(self) -> dict[str, torch.Tensor]:
        state = self.simulation.tensors
        terminated = (state["terminated"] != 0).unsqueeze(-1)
        over = state["macro_step"] >= self.macro_steps
        if self.arrivals is not None:
            over = state["local_step"] >= self.settings.episode_steps
        truncated = over.unsqueeze(-1) & ~terminated
        return {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}

    def time_left(self, state) -> torch.Tensor:
        """Share of the episode that is left, float32 [S], by the state of S envs."""
        if self.arrivals is not None:
            return 1.0 - state["local_step"].float() / self.settings.episode_steps
        return 1.0 - state["macro_step"].float() / self.macro_steps

    def observe(self, mask: torch.Tensor | None = None) -> TensorDict:
        """What the teams see now, and info of the step just made.

        New tensors, never the simulation's own: collectors keep what they get. ``mask`` int32 [E]: pictures and
        targets of these envs only, the others' are black and 0.
        """
        e, n = self.num_envs, self.num_robots
        own, team = self.space.observe(self, mask)
        state = self.simulation.tensors
        left = self.time_left(state)
        observation = own | {
            "comm": state["comm"].clone(),
            "time_left": left.reshape(e, 1, 1).repeat(1, n, 1),
            "alive": (state["collided"] == 0) & (state["failed"] == 0),
        }
        if self.target_view is not None:
            seen = self.target_view.observe(mask)
            observation |= {"targets": seen["features"], "targets_mask": seen["mask"]}
        agents = TensorDict(
            {"observation": TensorDict(observation, batch_size=[e, n], device=self.device)},
            batch_size=[e, n],
            device=self.device,
        )
        if self.arrivals is not None:
            agents["deciding"] = self.arrivals.state["deciding"].clone()
        parts = {
            "agents": agents,
            "info": TensorDict(self._info(), batch_size=[e], device=self.device),
        }
        if team:
            parts["team"] = TensorDict(team, batch_size=[e], device=self.device)
        return TensorDict(parts, batch_size=[e], device=self.device)

    def _info(self) -> dict[str, torch.Tensor]:
        s = self.simulation.tensors
        total = self.simulation.map_tensors["total_weight"][s["map_id"].long()]
        length = self.settings.episode_steps
        area = s["covered_sum"] + (length - s["local_step"]) * s["covered"].long()
        info = {
            "coverage": (s["covered"].float() / total).unsqueeze(-1),
            "coverage_auc": (area.double() / (length * total)).float().unsqueeze(-1),
            "local_steps": s["local_step"].unsqueeze(-1).clone(),
            "collided": s["collided"] != 0,
            "path_length": s["path_length"].clone(),
            "episode_reward": s["episode_reward"].clone(),
            "episode_reward_unscaled": s["unscaled"].sum(-1),
        }
        for k, mark in enumerate(MARKS):
            info[f"coverage_step_{mark}"] = s["milestone_step"][:, k : k + 1].clone()
            info[f"mutual_overlap_{mark}"] = s["milestone_overlap"][:, k : k + 1].clone()
            info[f"path_length_{mark}"] = s["milestone_path"][:, :, k].clone()
        for k, term in enumerate(REWARD_TERMS):
            info[f"reward_{term}"] = s["terms"][:, :, k].clone()
        if self.settings.faults.enabled:
            info["failed"] = s["failed"] != 0
        if self.settings.odometry.enabled:
            info["odometry_error"] = (self.simulation.believed["center"] - s["center"]).norm(dim=-1)
        if self.settings.odometry.map_errors:
            info["map_error"] = self.simulation.map_error().unsqueeze(-1)
        return info | self.space.measure(self) | (self._radio_info(total) if self.settings.limited else {})

    def _radio_info(self, total: torch.Tensor) -> dict[str, torch.Tensor]:
        """Who knows how much; ``total`` is the weight of each team's map, int32 [E]."""
        s, robots = self.simulation.tensors, self.num_robots
        length, steps = self.settings.episode_steps, s["local_step"]

        def tell(name: str, weight: torch.Tensor, sums: torch.Tensor) -> dict[str, torch.Tensor]:
            area = sums + (length - steps) * weight.long()
            mean = (area.double() / (length * total)).float()
            return {name: (weight.float() / total).unsqueeze(-1), f"{name}_auc": mean.unsqueeze(-1)}

        info = tell("worst_coverage", s["known_weight"][:, :robots].amin(1), s["worst_sum"])
        info["told_step_95"] = s["told_step"].unsqueeze(-1).clone()
        info["bytes_sent"] = CELL_BYTES * s["cells_sent"].unsqueeze(-1)
        info["connected"] = s["connected"].float() / steps.clamp_min(1).unsqueeze(-1)
        if self.comm_config.has_base:
            info |= tell("base_coverage", s["known_weight"][:, robots], s["base_sum"])
        if self.settings.done != "union":
            info["counted_coverage"] = (s["counted"].float() / total).unsqueeze(-1)
        return info

    def _raise_errors(self) -> None:
        error = self.simulation.tensors["error"]
        if not bool(error.any()):
            return
        codes = torch.bitwise_and(error, ERRORS)
        code = int(codes.max())
        word, env = torch.where(codes == code, error, torch.iinfo(error.dtype).max).min(0)
        room, env = int(word) // ROOM_UNIT, int(env)
        error.zero_()
        if code & ERROR_CAPACITY:
            raise RuntimeError(
                f"env {env}: a radar buffer overflowed; this is a bug of the bounds in envs/maps/map_batch.py"
            )
        if code & ERROR_START:
            raise MapError(
                f"starts drawn at random left room for {room} of num_robots={self.num_robots} robots (env {env}): "
                f"{NO_ROOM}"
            )
        if code & ERROR_REGION:
            raise ValueError(f"the action of env {env} names a region that is none: give 0 to {REGIONS**2 - 1}")
        raise ValueError(f"the action of env {env} is NaN or infinite: the policy has diverged or was fed wrongly")

    # Seeds, evaluation, state

    def _set_seed(self, seed: int | None) -> None:
        self.simulation.tensors["seed"].fill_(int(seed or 0) & 0x7FFFFFFF)
        self.simulation.tensors["episode"].fill_(-1)
        self._fix_starts()

    def set_starts(self, poses: np.ndarray | torch.Tensor | Sequence | None) -> None:
        """Where the robots stand at every following reset; None: drawn anew, as the env was made.

        Args:
            poses: centre x, y [m] and heading [rad] of every robot, float [N, 3] for all envs or [E, N, 3].

        Raises:
            ValueError: of another shape, not finite, in a wall or on top of another robot, on any of the env's maps.
        """
        given = self.simulation.tensors["starts"]
        if poses is None:
            given.fill_(torch.inf)
        else:
            given.copy_(torch.from_numpy(self.space.check_starts(self, poses)))

    def _fix_starts(self) -> None:
        if self.starts == "fixed":
            fixed = self.space.fixed_starts(self, int(self.simulation.tensors["seed"]))
            self.simulation.map_starts.copy_(torch.from_numpy(fixed))

    def set_episodes(self, ids: torch.Tensor) -> None:
        """Let env i play evaluation episode ``ids[i]`` at the next reset: map (they take turns) and starts from
        (seed, id) alone."""
        self.simulation.tensors["env_id"].copy_(ids)
        self.simulation.tensors["episode"].fill_(EVALUATION - 1)

    def state_dict(self, *args, **kwargs) -> dict[str, torch.Tensor]:
        """The simulator's state, copied: loading it continues bit for bit on the same device."""
        state = {name: self.simulation.tensors[name].clone() for name in self.space.STATE}
        return state | self._memories()

    def _memories(self) -> dict[str, torch.Tensor]:
        """What those remember that look at the simulation, copied."""
        parts = (self.strategy, self.target_view, self.arrivals)
        return {name: value for part in parts if part is not None for name, value in part.state_dict().items()}

    def load_state_dict(self, state_dict: dict[str, torch.Tensor], strict: bool = True, **kwargs) -> None:
        """Continue from a state taken by `state_dict` of an env with the same settings and maps."""
        own = self.simulation.tensors
        wanted = {name: own[name] for name in self.space.STATE} | self._memories()
        wrong = [n for n, value in wanted.items() if n not in state_dict or state_dict[n].shape != value.shape]
        if wrong:
            raise ValueError(
                f"the saved simulator state does not fit this env ({', '.join(wrong[:3])}): "
                "use the maps, num_envs, num_robots and version of MAexp it was saved with"
            )
        for name in self.space.STATE:
            own[name].copy_(state_dict[name])
        self._fix_starts()
        for part in (self.strategy, self.target_view, self.arrivals):
            if part is not None:
                part.load_state_dict(state_dict)

    def __reduce__(self):
        return rebuild, describe(self)

    def __deepcopy__(self, memo: dict) -> "ExplorationEnv":
        return rebuild(*describe(self))  # with the same maps: nothing changes them

    # Looking in

    def set_step_hook(self, hook: Callable[["ExplorationEnv"], None] | None, every: int = 1) -> None:
        """Call ``hook(env)`` after every reset and every ``every``-th local step; None stops that."""
        self._hook = None if hook is None else (hook, positive_count("every", every))

    def snapshot(self, index: int = 0) -> dict:
        """What env ``index`` looks like now, as NumPy arrays, points in the order of its map (for drawing)."""
        return self.space.take_snapshot(self, index)

    def render(self, index: int | Sequence[int] = 0, size: int = 512, mode: str = "rgb_array") -> np.ndarray:
        """A picture of env ``index``, or of several side by side: uint8 [height, width, 3], ``size`` wide each.

        TorchRL's ``PixelRenderTransform`` and ``VideoRecorder`` work with it; ``mode`` is there because they may
        name it, and has this one value.
        """
        from maexp.envs.render.frames import check_teams, draw_teams

        if mode != "rgb_array":
            raise ValueError(f"mode={mode!r} is unknown: this env renders rgb_array")
        return draw_teams([self.snapshot(team) for team in check_teams(self, index)], size)
