"""What robots do about radios that do not reach: `comm.strategy`, around any planner or policy.

A strategy takes over where its rules send a robot to tell somebody what it knows; else the robot goes where its policy
sends it. The rules use what the robot itself can know: its own map and odometer, the time, where the base station is,
and whom it was connected with when, over any number of others. How far it is back into contact a robot guesses from the
straight line, and from its odometer: no farther than it has driven since.

Sources: reports to a base, PRoID (arXiv 2604.10433); appointments, Tellaroli et al. 2023 (2309.13494); a relay, Hua et
al. 2025 (2510.04161); pursuit where it pays, mTARE (Cao et al. 2023).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from maexp.envs.targets.features import DETOUR, PACE
from maexp.kernels import unpack_flags
from maexp.kernels.constants import DT

if TYPE_CHECKING:
    from maexp.envs.environment import ExplorationEnv

IDLE = 2  # decisions without anything new after which a robot has nothing better to do than to tell
PATIENCE = 3  # decisions that robots wait for others after the time agreed on
WORTH = 1.0  # a pursuit pays where the other misses so many radar discs, and
WAY_COST = 0.3  # as many more for every radar range of way there
NEAR = 0.5  # a robot this near to a place is there [radar ranges]
TEAMS = 64  # whose points are compared at once
TELLING = ("opportunistic", "return_to_base", "courier")  # a policy may choose to tell the base station sooner


class Strategy:
    """The strategy of an env's teams, and what robots remember of whom they were connected with.

    Args:
        env: the env; only read.
        name: of the strategy; None: `comm.strategy`.

    Attributes:
        known: int32 [E, N], what robots know; ``linked`` bool [E, N, U], with whom they are connected, where links
            fade since the decision before; ``done`` bool [E, N, U], who of those knows all that they know; ``way``
            [E, N, U], how far it is back into contact [m]; ``left`` [E, N], how far they still get in the episode [m]:
            of the last `look`.
        state: tensors that later decisions depend on; U radios, the base station's last. ``met`` int32 [E, N, U], the
            macro step in which a robot was last connected with a radio, -1: never; ``place`` [E, N, U, 2], where that
            was then [m]; ``driven`` [E, N, U], the robot's odometer then [m]; ``told`` int32 [E, N, U], what of its
            knowledge that radio had then; ``eased`` int32 [E, N], when another last set out with all that it knows;
            ``knew`` and ``grew`` int32 [E, N], what it knew last and when that last became more; ``duty`` bool [E, N],
            who is on its way to tell; ``due`` int32 [E, N], ``spot`` [E, N, 2] and ``party`` bool [E, N, U]: when,
            where and with whom it has an appointment.
    """

    def __init__(self, env: ExplorationEnv, name: str | None = None):
        self.env, self.name, self.given_period = env, name or env.comm_config.strategy, env.comm_config.period
        s, device = env.simulation.tensors, env.device
        e, n, u = *s["center"].shape[:2], s["known_weight"].shape[1]
        self.has_base, self.robots = env.comm_config.has_base, n
        comm = env.comm_config
        self.fades = comm.noise > 0.0 or comm.loss > 0.0  # links come and go: one moment says little
        self.asks = comm.messages  # who is connected may not know all
        self.reach = max(radar.range for radar in env.radar_configs)
        self.drive = env.simulation.robot_tensors["max_speed"] * (PACE * DT * env.local_steps)  # of a decision [m]

        def zeros(*shape: int, dtype: torch.dtype = torch.int32) -> torch.Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        self.state = {
            "met": zeros(e, n, u),
            "place": zeros(e, n, u, 2, dtype=torch.float32),
            "driven": zeros(e, n, u, dtype=torch.float32),
            "told": zeros(e, n, u),
            "eased": zeros(e, n),
            "knew": zeros(e, n),
            "grew": zeros(e, n),
            "duty": zeros(e, n, dtype=torch.bool),
            "due": zeros(e, n),
            "spot": zeros(e, n, 2, dtype=torch.float32),
            "party": zeros(e, n, u, dtype=torch.bool),
        }

    @torch.no_grad()
    def direct(self, goal: torch.Tensor, tells: torch.Tensor | None = None) -> torch.Tensor:
        """Where robots go, given where their policy sends them, float32 [E, N, 2] [m]; `tells`, bool [E, N]: whom it
        sends to tell the base station, until they have told it."""
        self.look()
        if tells is not None:
            self.state["duty"] |= tells & self.can_tell()
        duty, own = getattr(self, f"_{self.name}")()
        self.state["duty"] = duty & (self.sim["collided"] == 0)
        return torch.where(self.state["duty"].unsqueeze(-1), own, goal)

    def can_tell(self) -> torch.Tensor:
        """Robots that may choose to go and tell the base station something that it does not know, bool [E, N]."""
        if not self.has_base or self.name not in TELLING:
            return torch.zeros_like(self.state["duty"])
        return self._has_news(self.robots) & (self.sim["collided"] == 0)

    def busy(self) -> torch.Tensor:
        """Robots that are on their way to tell, whatever they choose now, bool [E, N]."""
        return self.state["duty"] & (self.can_tell() if self.name in TELLING else True)

    # What a robot knows of the others

    def look(self) -> None:
        """Bring the memory up to date: who is connected with whom now. A second time it changes nothing."""
        self.sim = sim = self.env.simulation.believed
        s, n = self.state, self.robots
        self.step = sim["macro_step"].view(-1, 1)
        self.known = sim["known_weight"][:, :n]
        self.at = sim["center"][..., :2]
        radios = torch.cat([self.at, sim["base"][:, None, :2]], 1)[:, : s["met"].shape[-1]]
        self.linked = links = self._links()
        begins = self.step == 0
        wide = begins.unsqueeze(-1)
        odometer = sim["path_length"]
        for name, blank in (("met", -1), ("driven", 0), ("told", 0), ("party", False)):
            s[name] = s[name].masked_fill(wide, blank)
        for name, blank in (("duty", False), ("eased", 0), ("knew", 0), ("grew", 0), ("due", 0)):
            s[name] = s[name].masked_fill(begins, blank)
        s["place"] = torch.where(links.unsqueeze(-1), radios.unsqueeze(1), s["place"])
        s["met"] = torch.where(links, self.step.unsqueeze(-1).to(torch.int32), s["met"])
        s["driven"] = torch.where(links, odometer.unsqueeze(-1), s["driven"])
        s["told"] = torch.where(links, self._shared() if self.asks else self.known.unsqueeze(-1), s["told"])
        self.done = links & (s["told"] >= self.known.unsqueeze(-1))
        s["grew"] = torch.where(self.known > s["knew"], self.step.to(torch.int32), s["grew"])
        s["knew"] = self.known.clone()
        if self.has_base:  # every robot knows where that is
            s["place"][:, :, n] = sim["base"][:, None, :2]
        self.straight = (s["place"] - self.at.unsqueeze(2)).norm(dim=-1)
        since = torch.where(s["met"] < 0, torch.inf, odometer.unsqueeze(-1) - s["driven"])
        self.way = torch.minimum(since, DETOUR * self.straight)  # into contact with a radio again [m]
        self.rest = self.env.macro_steps - self.step  # decisions left
        self.left = self.rest * self.drive  # how far a robot still gets in the episode [m]
        self.idle = self.step - s["grew"] >= IDLE

    def _links(self) -> torch.Tensor:
        """Radios that each robot is connected with over any number of others, bool [E, N, U]."""
        words = self.sim["hears"] | self.sim["contacts"] if self.fades else self.sim["hears"]
        radios = words.shape[1]
        links = unpack_flags(words.transpose(1, 2).contiguous(), radios).transpose(1, 2).float()
        for _ in range(max(radios - 1, 1).bit_length()):
            links = ((links @ links) > 0).float()
        return links[:, : self.robots] > 0

    def _shared(self) -> torch.Tensor:
        """How much of what each robot knows each radio knows, too, int32 [E, N, U]: connected radios tell each other
        which points they know, free and at once (`maexp.kernels.bandwidth`)."""
        maps, sim = self.env.simulation.map_tensors, self.sim
        radios, points = self.state["told"].shape[-1], sim["known_free"].shape[-1]
        parts = []
        for teams in torch.arange(len(sim["map_id"]), device=self.env.device).split(TEAMS):
            number = sim["map_id"][teams].long()
            index = maps["free_begin"][number].long().unsqueeze(-1) + torch.arange(points, device=teams.device)
            there = index < maps["free_begin"][number + 1].long().unsqueeze(-1)
            weight = torch.where(there, maps["free_weight"][index.clamp_max(len(maps["free_weight"]) - 1)], 0).double()
            known = unpack_flags(sim["known_free"][teams], radios).double()
            parts.append((known[:, : self.robots] * weight.unsqueeze(1)) @ known.transpose(1, 2))
        return torch.cat(parts).round().to(torch.int32)

    def _period(self, cost: torch.Tensor, rest: torch.Tensor) -> torch.Tensor:
        """Decisions from one report to the next, where each takes `cost` of them and so many are left.

        A robot that learns at an even rate, but nothing while it reports, tells most over a time L if it reports every
        x = sqrt(c L), with c the time of a report: what it tells, integrated over the time, is in proportion to
        (x - c) (L - x) / x. Half the time left counts, for the less is unknown the slower robots learn.
        """
        if self.given_period != "auto":
            return torch.full_like(cost, float(self.given_period))
        return (0.5 * cost * rest).sqrt()

    # The strategies: bool [E, N], who is taken over, and float32 [E, N, 2], where to [m]

    def _opportunistic(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Nobody but who has chosen to tell the base station, until that is done."""
        if not self.has_base:
            return torch.zeros_like(self.state["duty"]), self.at
        return self.state["duty"] & self.can_tell(), self.state["place"][:, :, self.robots]

    def _return_to_base(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Who has something to tell reports after `comm.period`, when nothing new comes, and in time before the end.

        A period that is given counts to where the robot turns back, the other one to where it arrives.
        """
        n = self.robots
        return (self._is_due() | self._is_late()) & self._has_news(n), self.state["place"][:, :, n]

    def _is_due(self) -> torch.Tensor:
        """Robots that are on their way to report, or are to set out, bool [E, N]."""
        n, s = self.robots, self.state
        since = self.step - s["met"][..., n].clamp_min(0).maximum(s["eased"])
        way = self.way[..., n] / self.drive
        away = since + (way if self.given_period == "auto" else 0.0)
        return s["duty"] | (away >= self._period(2.0 * way, self.rest + since)) | self.idle

    def _courier(self) -> tuple[torch.Tensor, torch.Tensor]:
        """As `_return_to_base`, but one goes for all: of robots that are connected and know the same, whoever is
        soonest there. The others take for told what it knows, and their period begins anew; also on the way, and where
        they meet one that is on its way.

        Before the end nobody sets out for another that still has time.
        """
        n, s = self.robots, self.state
        news = self._has_news(n) & (self.sim["collided"] == 0)
        due, late = self._is_due() & news, self._is_late() & news
        way, number = self.way[..., n] / self.drive, torch.arange(n, device=self.at.device)  # of the way, decisions
        sooner = way.unsqueeze(1) < way.unsqueeze(2)
        sooner |= (way.unsqueeze(1) == way.unsqueeze(2)) & (number < number.unsqueeze(-1))
        mates = self.done[..., :n]
        if self.fades and not self.asks:  # a contact since the last decision may be over, and not know the latest
            mates = mates & (self._shared()[..., :n] >= self.known.unsqueeze(-1))
        takes = mates & news.unsqueeze(1) & sooner  # [i, j]: j knows what i knows, and is sooner there
        gives, heir = takes.any(-1), torch.where(takes, way.unsqueeze(1), torch.inf).argmin(-1)
        asked = torch.zeros_like(s["due"]).scatter_add_(1, heir, (due & gives).int()) > 0
        go = ((due | late) & ~gives) | asked
        eased = news & ~go & ((late & gives) | (mates & go.unsqueeze(1)).any(-1))
        s["told"][..., n] = torch.where(eased, self.known, s["told"][..., n])
        s["eased"] = torch.where(eased, self.step.to(torch.int32), s["eased"])
        return go, s["place"][:, :, n]

    def _has_news(self, radio: int) -> torch.Tensor:
        """Robots that know what a radio did not know when they were last connected, or does not yet."""
        return self.known > self.state["told"][..., radio]

    def _is_late(self) -> torch.Tensor:
        """Robots that get back to the base station just before the episode ends."""
        return self.left <= self.way[..., self.robots] + self.drive

    def _rendezvous(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Robots that are connected agree to meet after `comm.period`, at the base station or where the first of them
        is; whoever is parted from others of its party is there in time, and waits. How far apart they will be then
        they take from how wide the ground is that they know."""
        s, n = self.state, self.robots
        mates = self.linked[..., :n]
        missing = (s["party"] & ~self.done).any(-1) & (self.step <= s["due"] + PATIENCE)
        bound = mates & missing.unsqueeze(1)  # [i, j]: i is with j, who has promised to meet somebody else
        due = torch.where(bound, s["due"].unsqueeze(1), torch.iinfo(torch.int32).max)
        first = due.argmin(-1)  # the earliest promise counts for all who are together
        keeps = bound.any(-1)
        leader = mates.float().argmax(-1)  # the first of those connected
        party = self.linked.clone()
        spot = self._pick(self.at, leader)
        if self.has_base:
            party[..., n], spot = True, s["place"][:, :, n]
        wide = self.reach * (self.known / self._disc()).sqrt()  # radius of a disc of as much ground [m]
        cost = 2.0 * DETOUR * wide / self.drive + PATIENCE
        period = self._period(cost, self.rest).round().clamp_min(1.0).gather(1, leader)
        s["due"] = torch.where(keeps, s["due"].gather(1, first), self.step + period).to(torch.int32)
        s["spot"] = torch.where(keeps.unsqueeze(-1), self._pick(s["spot"], first), spot)
        promised = s["party"].gather(1, first.unsqueeze(-1).expand_as(s["party"])) | self.linked
        s["party"] = torch.where(keeps.unsqueeze(-1), promised, party)
        absent = s["party"] & ~self.done
        time = (s["due"] - self.step) * self.drive
        back = (DETOUR * (s["spot"] - self.at).norm(dim=-1)).minimum(self._driven(absent)) + self.drive
        news = (absent & (self.known.unsqueeze(-1) > s["told"])).any(-1)
        go = absent.any(-1) & ((time <= back) | (self.idle & news) | (s["duty"] & keeps))
        if self.has_base:
            go = go | (self._is_late() & self._has_news(n))
        return go, s["spot"]

    def _driven(self, absent: torch.Tensor) -> torch.Tensor:
        """How far robots have driven since they parted from the last of those `absent` [m], float32 [E, N]."""
        since = self.sim["path_length"].unsqueeze(-1) - self.state["driven"]
        return torch.where(absent, since, 0.0).amax(-1)

    def _pick(self, places: torch.Tensor, robot: torch.Tensor) -> torch.Tensor:
        """Rows [E, N, 2] of others' places, int64 [E, N]."""
        return places.gather(1, robot.unsqueeze(-1).expand(-1, -1, 2))

    def _disc(self) -> torch.Tensor:
        """What a radar's disc of free ground weighs on each env's map, float32 [E, 1]."""
        maps = self.env.simulation.map_tensors
        area = torch.tensor([world.free_area for world in self.env.maps], dtype=torch.float32, device=self.env.device)
        return (maps["total_weight"] / area * torch.pi * self.reach**2)[self.sim["map_id"].long()].view(-1, 1)

    def _relay(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The last robot goes to and fro between the base station and whom it has not met for longest; the others come
        home when they find nothing new, and in time before the end."""
        s, n = self.state, self.robots
        home, goal = self._has_news(n), s["place"][:, :, n].clone()
        go = home & (s["duty"] | self.idle | self._is_late())
        last = n - 1
        met = s["met"][:, last, :last]
        unheard = (met >= 0) & ~self.linked[:, last, :last]
        fresh = met > s["met"][:, last, n : n + 1]  # met since it was last connected with the base station
        report = home[:, last] & (fresh.any(-1) | self.idle[:, last] | self._is_late()[:, last])
        oldest = torch.where(unheard, met, torch.iinfo(torch.int32).max).argmin(-1)
        where = s["place"][:, last, :last][torch.arange(len(met), device=met.device), oldest]
        seek = ~report & unheard.any(-1) & ((where - self.at[:, last]).norm(dim=-1) > NEAR * self.reach)
        go[:, last] = report | seek
        goal[:, last] = torch.where(report.unsqueeze(-1), goal[:, last], where)
        return go, goal

    def _pursuit(self) -> tuple[torch.Tensor, torch.Tensor]:
        """A robot goes to where it last heard the one that misses most, the base station too, as soon as that pays."""
        s = self.state
        gap = self.straight / self.reach
        there = (gap <= NEAR) & ~self.linked  # nobody is here any more: it will not be looked for again
        s["told"] = torch.where(there, self.known.unsqueeze(-1), s["told"])
        misses = (self.known.unsqueeze(-1) - s["told"]) / self._disc().unsqueeze(-1)
        known = s["met"] >= 0
        if self.has_base:
            known[..., self.robots] = True
        pays = torch.where(known, misses - WORTH - WAY_COST * gap, -torch.inf)
        best, whom = pays.max(-1)
        goal = s["place"].gather(2, whom.view(*whom.shape, 1, 1).expand(-1, -1, 1, 2)).squeeze(2)
        go = best > 0.0
        if self.has_base:
            home = self._has_news(self.robots) & (self._is_late() | self.idle)
            goal = torch.where(home.unsqueeze(-1), s["place"][:, :, self.robots], goal)
            go = go | home
        return go, goal

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Everything that later decisions depend on, copied."""
        return {f"strategy_{name}": value.clone() for name, value in self.state.items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on where `state_dict` was taken."""
        for name, value in self.state.items():
            self.state[name] = state[f"strategy_{name}"].to(value).clone()
