"""Teams whose robots decide when they arrive (`scenario.decide=arrival`), each at a moment of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from maexp.envs.maps.nav_grid import bank_block_sides
from maexp.envs.targets.navigation import known_grids
from maexp.kernels.arrivals import _find_arrivals
from maexp.kernels.constants import MARGIN_CELLS
from maexp.kernels.launches import launch_named, launch_on, record, replay, view

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

LONGEST_LOOK = 5  # local steps between two looks whether somebody has arrived, at most


class Arrivals:
    """When the robots of an env decide, and what they hold to until then.

    A decision of a team lasts until one of its robots has arrived at its target, or that is explored or taken by
    another, or the robot has held it for the env's `local_steps`.

    Args:
        env: only read.

    Attributes:
        every: local steps from look to look.
        state: tensors that later decisions depend on: ``deciding`` bool [E, N], ``aim`` float32 [E, N, 2] [m], the
            target of each robot, ``has_aim`` bool [E, N], whether it has one, and ``since`` int32 [E, N], local steps
            since it decided.
    """

    def __init__(self, env: ExplorationEnv):
        shape, device = (env.num_envs, env.num_robots), env.device
        self.env, self.launch = env, launch_on(device)
        self.every = next(n for n in range(LONGEST_LOOK, 0, -1) if env.local_steps % n == 0)
        self.known = known_grids(env)
        self.state = {
            "deciding": torch.ones(shape, dtype=torch.bool, device=device),
            "aim": torch.zeros((*shape, 2), device=device),
            "has_aim": torch.zeros(shape, dtype=torch.bool, device=device),
            "since": torch.zeros(shape, dtype=torch.int32, device=device),
        }
        self._paint = record(self.known.paint, self.known.known.device)
        self.clearance = float(env.simulation.robot_tensors["clearance"].max())
        self._reach = wp.array(self._find_reach(), dtype=wp.int32, device=str(device))
        self._proposal: tuple[torch.Tensor, torch.Tensor] | None = None

    def _find_reach(self) -> np.ndarray:
        """How far from a target its frontier may lie on each map, in cells (`maexp.kernels.frontier_clusters`)."""
        least = min(radar.range for radar in self.env.radar_configs)
        threshold = float(self.env.simulation.robot_tensors["collision_threshold"].max())
        outside = np.ceil(threshold / self.known.grids.cell.numpy() + MARGIN_CELLS).astype(np.int32) + 1
        return bank_block_sides(self.env.bank, least) + outside

    def begin(self, mask: torch.Tensor) -> None:
        """All robots of the envs of ``mask`` int32 [E], which begin an episode, decide."""
        begins = (mask != 0).unsqueeze(-1)
        self.state["deciding"] = self.state["deciding"] | begins
        self.state["has_aim"] = self.state["has_aim"] & ~begins

    def hold(self, target: torch.Tensor) -> torch.Tensor:
        """Candidates int64 [E, N] that robots name, with those that they are on the way to where they do not decide."""
        view = self.env.target_view
        same = view.state["mask"] & (view.state["block"] == view.tracker.state["chosen"])
        held = ~self.state["deciding"] & same.any(-1)
        return torch.where(held, same.int().argmax(-1), target)

    def propose(self, points: torch.Tensor, some: torch.Tensor) -> None:
        """A policy sends robots to targets, float32 [E, N, 2] [m]; bool [E, N], whether there are any."""
        self._proposal = points, some

    def take(self, wanted: torch.Tensor) -> torch.Tensor:
        """Goals float32 [E, N, 2] [m]: what is wanted of robots that decide, and of the others what was.

        Robots that were sent to no target arrive nowhere: they decide again when their team does.
        """
        s = self.state
        deciding = s["deciding"].unsqueeze(-1)
        points, some = self._proposal or (wanted, torch.zeros_like(s["has_aim"]))
        self._proposal = None
        s["aim"] = torch.where(deciding, points, s["aim"])
        s["has_aim"] = torch.where(s["deciding"], some, s["has_aim"])
        return torch.where(deciding, wanted, self.env.simulation.tensors["goal"])

    def play(self, hook) -> None:
        """The local steps of a decision, until somebody of each team decides."""
        env, state = self.env, self.env.simulation.tensors
        running, since = state["active"].clone(), self.state["since"] * ~self.state["deciding"]
        found = torch.zeros_like(self.state["deciding"])
        for start in range(0, env.local_steps, self.every):
            env.simulation.step(start, self.every)
            if hook is not None:
                hook(env)
            since += self.every * state["active"].unsqueeze(-1)
            arrived = self._look() | ((since >= env.local_steps) & self._alive())
            found |= arrived
            over = arrived.any(-1) | (state["local_step"] >= env.settings.episode_steps)
            state["active"] *= 1 - over.to(torch.int32)
            if not bool(state["active"].any()):
                break
        state["active"] |= running * (state["terminated"] == 0)
        self.state["deciding"], self.state["since"] = found | ~self.state["has_aim"], since

    def _alive(self) -> torch.Tensor:
        """Robots that move, of teams that play: bool [E, N]."""
        state = self.env.simulation.tensors
        return (state["active"] != 0).unsqueeze(-1) & (state["collided"] == 0)

    def _look(self) -> torch.Tensor:
        """Who decides now, bool [E, N]."""
        replay(self._paint)
        arrived, sim = torch.empty_like(self.state["deciding"]), self.env.simulation
        aim, has_aim = (self.state[name].contiguous() for name in ("aim", "has_aim"))
        values = vars(self.known) | {
            "reach": self._reach,
            "clearance": self.clearance,
            "active": view(sim.tensors["active"]),
            "collided": view(sim.tensors["collided"]),
            "center": view(sim.believed["center"], wp.vec3),
            "aim": view(aim, wp.vec2),
            "has_aim": view(has_aim),
            "arrived": view(arrived),
        }
        launch_named(self.launch, _find_arrivals, tuple(arrived.shape), values)
        return arrived

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Everything that later decisions depend on, copied."""
        return {f"arrival_{name}": value.clone() for name, value in self.state.items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on where `state_dict` was taken."""
        for name in self.state:
            self.state[name] = state[f"arrival_{name}"].to(self.state[name]).clone()
