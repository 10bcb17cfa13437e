"""Targets of teams in volumes, for the planners and the learned choice of the plane: the same scene in three
dimensions."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import torch

from maexp.envs.targets.navigation import RowView
from maexp.envs.targets.tracker import DWELL, STUCK, TargetTracker, TensorScene, keyed_uniform
from maexp.kernels.constants import DT
from maexp.kernels.launches import launch_named, launch_on, view
from maexp.kernels.volume.coarse import UNREACHED, _first_cells

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv


class VolumeNavigation:
    """What there is to choose from, of all envs of an `ExplorationEnv`, or of `some`: E below then counts those.

    R rows per env hold what is known: 1 where all communicate, else N. K is the number of blocks of the largest map, T
    the most blocks with a target that an env has now. Attributes below are valid after `update`.

    Attributes:
        block: int64 [E, 1, T], blocks with a target in some row, in order; -1 fills up.
        cell: int64 [E, R, T], the cells to go to for these; -1: none.
        point: float32 [E, N, T, 3], where those are [m].
        way: float32 [E, N, T], how far each robot has to fly there [m]; infinite: there is no way.
        around: float32 [E, N, T], frontier voxels of the block.
        gain, heading: float32 [E, N, T], what is to be seen from there (in `bank.DISC_OF_VIEW` of a view), and where
            most of it is [rad].
        middle: float32 [E, N, T, 3], the middle of that, from the target [m].
    """

    def __init__(self, env: ExplorationEnv):
        self.sim, self.envs, self.env = env.simulation, None, env
        self.device, self.rows = env.device, env.num_robots if env.settings.limited else 1
        self.radar_range = max(radar.range for radar in env.radar_configs)
        self.clearance = max(robot.collision_threshold for robot in env.robot_configs)
        self.num_blocks = self.sim.tensors["target"].shape[-1]
        self.edge = env.bank.resolution * env.bank.side  # of a cell [m]
        self.cells = torch.tensor(
            [[-(-count // env.bank.side) for count in m.shape] for m in env.maps], device=env.device
        )
        self.view = env.bank.view  # voxels that count as one view

    def some(self, envs: torch.Tensor) -> VolumeNavigation:
        """The same of some envs, int64 [S]."""
        found = copy.copy(self)
        found.envs = envs
        return found

    def pick(self, values: torch.Tensor) -> torch.Tensor:
        """What concerns the envs looked at: [E, ...] -> [S, ...]."""
        return values if self.envs is None else values[self.envs]

    def put(self, values: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """`values` [E, ...] with `rows` [S, ...] for the envs looked at."""
        return rows if self.envs is None else values.index_copy_(0, self.envs, rows)

    @property
    def state(self) -> dict[str, torch.Tensor] | RowView:
        """The simulation's tensors."""
        return self.sim.tensors if self.envs is None else RowView(self.sim.tensors, self.envs)

    def update(self) -> None:
        """Bring everything up to date with the env."""
        self.sim.look(self.envs)
        s, robots = self.state, self.env.num_robots
        target = s["target"]  # [S, R, K]
        there = (target >= 0).any(1)
        most = max(int(there.sum(-1).max()), 1)
        order = (~there).to(torch.uint8).sort(dim=-1, stable=True).indices[:, :most]  # those with a target first
        filled = there.gather(1, order)
        self.block = torch.where(filled, order, -1).unsqueeze(1)

        def listed(name: str) -> torch.Tensor:
            values = s[name]
            index = order.unsqueeze(1).expand(-1, values.shape[1], -1)
            if values.dim() == 4:
                return values.gather(2, index.unsqueeze(-1).expand(-1, -1, -1, 3))
            return values.gather(2, index)

        self.cell = torch.where(filled.unsqueeze(1), listed("target"), -1).long()

        def of_robots(name: str) -> torch.Tensor:
            values = listed(name)
            return values.expand(-1, robots, *values.shape[2:]).float()

        self.point, self.gain, self.middle = (of_robots(name) for name in ("point", "gain", "middle"))
        self.heading, self.around = of_robots("best_heading"), of_robots("frontier_size")
        self.way = self.way_to(self.cell)

    def way_to(self, cells: torch.Tensor) -> torch.Tensor:
        """How far each robot has to fly to cells, int64 [E, R, T], -1: none; float32 [E, N, T] [m]."""
        distance = self.state["distance"]
        cells = cells.expand(-1, distance.shape[1], -1)
        steps = distance.gather(2, cells.clamp_min(0))
        there = (cells >= 0) & (steps < UNREACHED)
        return torch.where(there, steps.float() * self.edge, torch.inf)

    def alive(self) -> torch.Tensor:
        """Robots that still move, bool [E, N]."""
        s = self.state
        return (s["collided"] == 0) & (s["failed"] == 0) & (s["active"] != 0).unsqueeze(1)

    def centers(self) -> torch.Tensor:
        """Centres of the bodies [m]: float32 [E, N, 3]."""
        return self.state["center"]

    def cell_of_env(self) -> torch.Tensor:
        """Edge of a cell [m]: float32 [E]."""
        return torch.full(self.state["map_id"].shape, self.edge, device=self.device)

    def known_area(self) -> torch.Tensor:
        """What is known, as the area of as many radar discs [m^2]: float32 [E, R]."""
        s = self.state
        count = s["covered"].unsqueeze(1) if self.rows == 1 else s["known_weight"]
        return count.float() * (torch.pi * self.radar_range**2 / self.view)

    def places(self, cells: torch.Tensor) -> torch.Tensor:
        """Middles of cells [m]: int64 [E, ...] -> float32 [E, ..., 3]."""
        m = self.state["map_id"].long()
        shape = self.cells[m].view(-1, *[1] * (cells.dim() - 1), 3)
        ny, nz = shape[..., 1], shape[..., 2]
        index = torch.stack([cells // (ny * nz), cells // nz % ny, cells % nz], -1)
        origin = self.sim.map_tensors["lower"][m].view(-1, *[1] * (cells.dim() - 1), 3)
        return origin + (index + 0.5) * self.edge

    def points_on_way(self, cells: torch.Tensor, ahead: float) -> torch.Tensor:
        """Points ``ahead`` [cells] in front of robots on their ways to ``cells``, int64 [E, N, M], -1: none.

        Returns:
            float32 [E, N, M, 3] [m]; where the robot is where there is no way.
        """
        wanted = cells.to(torch.int32).contiguous()
        found = torch.empty_like(wanted)
        envs = torch.arange(len(wanted), device=self.device) if self.envs is None else self.envs
        values = self.sim.values | {
            "map_id": view(self.sim.tensors["map_id"]),
            "distance": view(self.sim.tensors["distance"]),
            "ahead": int(ahead),
            "env": view(envs.to(torch.int32)),
            "wanted": view(wanted),
            "cell": view(found),
        }
        launch_named(launch_on(self.device), _first_cells, tuple(wanted.shape), values)
        at = self.centers().unsqueeze(2)
        return torch.where((found >= 0).unsqueeze(-1), self.places(found.clamp_min(0).long()), at)


class VolumeTracker(TargetTracker):
    """The targets of an env's teams in volumes, with a memory of those that led nowhere; as `TargetTracker`."""

    dims = 3

    def __init__(self, env: ExplorationEnv):
        self.env, self.nav = env, VolumeNavigation(env)
        self.seconds = DT * env.local_steps
        shape, device = (env.num_envs, env.num_robots), env.device
        self.state = {
            "dwell": torch.zeros((*shape, self.nav.num_blocks), dtype=torch.int32, device=device),
            "chosen": torch.full((*shape, 1), -1, device=device),
            "stood": torch.zeros((*shape, 3), device=device),
            "counted": torch.full((env.num_envs,), -1, dtype=torch.int32, device=device),
            "home": torch.full((*shape, 3), torch.nan, device=device),
        }
        self.body = env.simulation.robot_tensors["collision_threshold"]

    def look(self, envs: torch.Tensor | None = None) -> TensorScene:
        """Bring everything up to date with the env, and give up what led nowhere (once a macro step)."""
        nav, robots = self.nav if envs is None else self.nav.some(envs), self.env.num_robots
        nav.update()
        self._note_home(nav)
        return TensorScene(
            travel=self._forget(nav),
            points=nav.point,
            size=nav.around,
            gain=nav.gain,
            middle=nav.middle,
            alive=nav.alive(),
            nav=nav,
            block=nav.block.clamp_min(0).expand(-1, robots, -1),
        )

    def goals(
        self, chosen: torch.Tensor, cell: torch.Tensor, toward: torch.Tensor, waits: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Goals float32 [E, N, 4]: x, y, z [m] and heading [rad] of what robots chose (`take`)."""
        s = self.env.simulation.tensors
        some, index, robots = chosen >= 0, chosen.long().clamp_min(0).unsqueeze(-1), self.env.num_robots
        points = s["point"].expand(-1, robots, -1, -1)
        turns = s["best_heading"].expand(-1, robots, -1)
        goal = points.gather(2, index.unsqueeze(-1).expand(-1, -1, -1, 3)).squeeze(2)
        aside = self.env.space.anywhere(self.env, keyed_uniform(self.env, 3))[0]
        if waits is not None and self.env.targets_config.distinct:
            aside = torch.where(waits.unsqueeze(-1), self._rest(), aside)
        goal = torch.where(some.unsqueeze(-1), goal, aside)
        heading = torch.where(some & self.env.simulation.looks_ahead, turns.gather(2, index).squeeze(-1), torch.nan)
        return torch.cat([goal, heading.unsqueeze(-1)], -1)

    def _forget(self, nav: VolumeNavigation) -> torch.Tensor:
        """`nav.way`, infinite for targets given up: robots stood beside them in vain, or got stuck on the way there; if
        nothing else is left, all are tried once more."""
        s = {name: nav.pick(value) for name, value in self.state.items()}
        now, at = nav.state["macro_step"], nav.centers()
        begins = (now == 0).view(-1, 1, 1)
        s["chosen"] = torch.where(begins | (nav.state["failed"] != 0).unsqueeze(-1), -1, s["chosen"])
        dwell = torch.where(begins, 0, s["dwell"])
        fresh = (now != s["counted"]).view(-1, 1) & (now != 0).view(-1, 1)
        stuck = (at - s["stood"]).norm(dim=-1) < STUCK * nav.clearance
        stuck = stuck & fresh & nav.alive() & (s["chosen"].squeeze(-1) >= 0)
        dwell = dwell.scatter_add(2, s["chosen"].clamp_min(0), stuck.unsqueeze(-1).to(torch.int32))
        near = (nav.point - at.unsqueeze(2)).norm(dim=-1) <= max(1.5 * nav.edge, nav.clearance)
        near = near & nav.way.isfinite() & fresh.unsqueeze(-1)
        if nav.rows == 1:
            near = near.any(1, keepdim=True).expand_as(near)
        block = nav.block.expand(-1, at.shape[1], -1)
        dwell = dwell.scatter_add(2, block.clamp_min(0), (near & (block >= 0)).to(torch.int32))
        given_up = (dwell.gather(2, block.clamp_min(0)) >= DWELL) & (block >= 0)
        kept = torch.where(given_up, torch.inf, nav.way)
        left = kept.isfinite().flatten(1).any(-1).view(-1, 1, 1)
        s |= {"dwell": torch.where(left, dwell, 0), "stood": at.clone(), "counted": now.clone()}
        self.state.update({name: nav.put(value, s[name]) for name, value in self.state.items() if name != "home"})
        return torch.where(left, kept, nav.way)
