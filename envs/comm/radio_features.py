"""What targets tell of radios (``observation.radio``): what a robot knows of who has heard what, and the target to go
and tell the base station.

Robots know what `maexp.envs.comm.strategy` remembers for them, where the base station is, and their own map. Nothing
here is of the true map, or of what others have learned since they were last heard.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
import warp as wp

from maexp.envs.simulation import radio_struct
from maexp.envs.targets.features import DETOUR, Contacts, FeatureInputs, add_telling, predict_margin
from maexp.envs.targets.heuristics import WAY_AHEAD
from maexp.envs.targets.navigation import Navigation
from maexp.kernels.constants import FREE, STRAIGHT, UNREACHED
from maexp.kernels.launches import launch_named, view
from maexp.kernels.radio import _count_known_blocked

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv


class ContactView:
    """What the robots of an env know of radios.

    Args:
        env: only read; it keeps a `Strategy`.
    """

    def __init__(self, env: ExplorationEnv):
        self.env, self.comm = env, env.comm_config
        self.cell = radio_struct(env.settings).cell  # of the signal's model [m]

    def look(self) -> None:
        """Bring the memory of the robots up to date."""
        self.env.strategy.look()

    def add_to(self, inputs: FeatureInputs, nav: Navigation) -> FeatureInputs:
        """The moment with one candidate more, [E, N, M + 1], to go and tell the base station, and with `Contacts`."""
        memory = self.env.strategy
        can = nav.pick(memory.can_tell()).unsqueeze(-1)
        base = nav.state["base"][:, None, :2]
        to = (base - inputs.at).unsqueeze(2)
        way, begin = self._way_to_base(nav, base, to)
        inputs = add_telling(inputs, can, way, begin, to)
        return replace(inputs, radio=self._contacts(inputs, nav))

    def goals(self) -> torch.Tensor:
        """Where robots go that tell the base station, float32 [E, N, 2] [m]."""
        base = self.env.simulation.tensors["base"][:, None, :2]
        return base.expand(-1, self.env.num_robots, -1)

    def _way_to_base(self, nav: Navigation, base: torch.Tensor, to: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """How far it is to the base station [m], [E, N, 1], and a point near the beginning of the way, from the robot,
        [E, N, 1, 2]; guessed from the straight line where the known ground does not lead there."""
        m = nav.state["map_id"].long()
        edge, width, height = nav.cell_of_env(), nav.width[m].long(), nav.height[m].long()
        x, y = ((base[:, 0] - nav.origin[m]) / edge.unsqueeze(-1)).floor().long().unbind(-1)
        cell = (torch.minimum(y.clamp_min(0), height - 1) * width + torch.minimum(x.clamp_min(0), width - 1)).view(
            -1, 1
        )
        cell = cell.expand(-1, to.shape[1]).unsqueeze(-1)
        steps = nav.distance.gather(2, cell)
        reached = steps < UNREACHED
        way = torch.where(reached, steps * edge.view(-1, 1, 1) / STRAIGHT, DETOUR * to.norm(dim=-1))
        ahead = nav.points_on_way(torch.where(reached, cell, -1), WAY_AHEAD) - nav.centers().unsqueeze(2)
        return way, torch.where(reached.unsqueeze(-1), ahead, to)

    def _contacts(self, inputs: FeatureInputs, nav: Navigation) -> Contacts:
        memory, steps = self.env.strategy, self.env.macro_steps
        n = self.env.num_robots
        disc, met, told, place = (
            nav.pick(tensor) for tensor in (memory._disc(), *(memory.state[name] for name in ("met", "told", "place")))
        )
        known, linked, step = (nav.pick(tensor) for tensor in (memory.known, memory.linked, memory.step))
        since = (step.unsqueeze(-1) - met).float() / steps
        untold = (known.unsqueeze(-1) - told) / disc.unsqueeze(-1)
        point = inputs.to + inputs.at.unsqueeze(2)
        others = ~torch.eye(n, dtype=torch.bool, device=point.device).expand(len(point), -1, -1)
        mates_far = (point.unsqueeze(3) - place[:, :, None, :n]).norm(dim=-1)
        mates_far = torch.where((others & (met[..., :n] >= 0)).unsqueeze(2), mates_far, torch.inf).amin(-1)
        mates_untold = torch.where(others, untold[..., :n], 0.0).amax(-1, keepdim=True)
        mates_since = torch.where(others, since[..., :n], 0.0).sum(-1, keepdim=True) / max(n - 1, 1)
        tells = torch.zeros_like(inputs.mask)
        tells[..., -1] = inputs.mask[..., -1]
        blank, flat = torch.zeros_like(inputs.travel), torch.zeros_like(mates_since)
        shared = {"mates_untold": mates_untold, "mates_since": mates_since, "mates_far": mates_far / inputs.reach}
        if not self.comm.has_base:
            none = dict.fromkeys(("untold", "since", "linked", "way", "spare"), flat)
            return Contacts(tells=tells, **none, far=blank, signal=blank, **shared)
        base = nav.state["base"][:, :2]
        gap = (point - base[:, None, None]).norm(dim=-1)
        way = nav.pick(memory.way)[..., n:]
        drive = nav.pick(memory.drive).unsqueeze(-1)
        return Contacts(
            tells=tells,
            untold=untold[..., n:],
            since=since[..., n:],
            linked=linked[..., n:],
            way=way / inputs.reach,
            spare=((nav.pick(memory.rest) - (way / drive).squeeze(-1)) / steps).unsqueeze(-1),
            far=gap / inputs.reach,
            signal=self._signal(nav, base, point, gap),
            **shared,
        )

    def _signal(self, nav: Navigation, base: torch.Tensor, point: torch.Tensor, gap: torch.Tensor) -> torch.Tensor:
        """As of `Contacts`, float32 [E, N, M]."""
        counts = self.comm.signal or self.comm.line_of_sight
        blocked = self._count_blocked(nav, base, point) if counts else torch.zeros_like(gap)
        return predict_margin(torch, self.comm, self.cell, gap, blocked, nav.cell_of_env().view(-1, 1, 1))

    def _count_blocked(self, nav: Navigation, base: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
        """Cells that are not known to be free between the base station and points, int32 [E, N, M]."""
        free = (nav.known == FREE).to(torch.uint8).flatten()
        blocked = torch.empty(point.shape[:-1], dtype=torch.int32, device=point.device)
        map_id, base, point = nav.state["map_id"].contiguous(), base.contiguous(), point.contiguous()
        values = nav.values() | {
            "map_id": view(map_id),
            "open": view(free),
            "rows": nav.rows,
            "cells": nav.known.shape[-1],
            "senders": view(base, wp.vec2),
            "receivers": view(point, wp.vec2),
            "blocked": view(blocked),
        }
        launch_named(nav.launch, _count_known_blocked, tuple(blocked.shape), values)
        return blocked
