"""What must hold in every env at every moment, asserted from outside with counts of its own.

A `Watch` follows an `ExplorationEnv` through its step hook: after every local step it looks at what each robot sees,
where it is and what it hit, and keeps its own flags, sums and rewards. `check_step` and `reset` compare these with what
the env hands out.
"""

import itertools
import math
from dataclasses import dataclass, field

import numpy as np
from oracle.motion import body_separation, rear_state
from scipy.spatial import cKDTree

from maexp.envs import ExplorationEnv
from maexp.envs.specs import REWARD_TERMS
from maexp.kernels import unpack_flags

NEAR = 2e-4  # [m]; float32 positions of some hundred metres
DT = 0.1
CLEAR_START = 3.0
PIXELS = 125
COUNTED = ("explore", "overlap", "time", "success", "collision")
"""The terms of the reward that are counted here, the first of all; of others only the sum is checked."""


@dataclass
class Place:
    """A map as the checks need it."""

    free: np.ndarray  # [F, 2] [m]
    boundary: np.ndarray  # [B, 2] [m]
    weight: np.ndarray  # [F], spacing squared in 16ths of its smallest
    exact: bool  # the weights are whole, so that the kernels' integers are exact
    walls: cKDTree | None
    frame: tuple[np.ndarray, float]  # centre of pixel (0, 0) and pixel size [m]


@dataclass
class Life:
    """One env's episode so far."""

    place: Place
    total_weight: int  # of all free points, as the kernels weigh them
    number: int  # of the episode
    seen: np.ndarray  # bool [N, F]
    centers: list = field(default_factory=list)  # [N, 2] after every local step since the last check
    covered: float = 0.0  # weight of the points the team has seen
    coverage: np.float32 = 0.0
    old: dict = field(default_factory=dict)  # the state after the last local step
    terms: np.ndarray = None  # [N, len(COUNTED)], of this macro step
    total: np.ndarray = None  # [N], of the episode
    milestone: list = field(default_factory=list)  # (local step, overlap, paths) at 85, 95 and 99 %
    macro_steps: int = 0
    over: bool = False  # terminated: nothing moves any more
    finished: bool = False  # terminated or truncated at the end of a macro step


class Watch:
    """Asserts at every local step of every env.

    `local_steps` and `crashes` count what was looked at.
    """

    def __init__(self, env: ExplorationEnv):
        self.env = env
        self.places = [_place(m) for m in env.maps]
        self.lives: list[Life | None] = [None] * env.num_envs
        least, widest = min(r.collision_threshold for r in env.robot_configs), max(m.resolution for m in env.maps)
        self.tight = env.collision == "centre" and least > 0.71 * widest  # no robot fits between boundary points
        self.resetting = False
        self.local_steps = self.crashes = self.successes = self.episodes = 0
        env.set_step_hook(self.look)

    def reset(self, td=None):
        """`env.reset`, watched: running envs stay as they are."""
        self.resetting = True
        td = self.env.reset(td)
        self.resetting = False
        for e in range(self.env.num_envs):
            self._check_observation(e, td[e])
        return td

    # Every local step

    def look(self, env: ExplorationEnv) -> None:
        """The hook: a new episode, one more local step, or an env at rest."""
        state = {name: tensor.cpu().numpy() for name, tensor in env.simulation.tensors.items()}
        for e in range(env.num_envs):
            life = self.lives[e]
            now = {
                name: state[name][e].copy()
                for name in (
                    "pose",
                    "slip",
                    "center",
                    "collided",
                    "crashed",
                    "path_length",
                    "local_step",
                    "covered",
                    "terms",
                    "discovered",
                    "overlap",
                )
            }
            if life is None or life.number != state["episode"][e]:
                self._begin(e, now, state)
            elif life.over or life.finished or self.resetting:
                for name in ("pose", "collided", "local_step", "covered", "path_length"):
                    assert np.array_equal(now[name], life.old[name]), f"{name} of an env at rest changed"
            else:
                self._follow(e, now, self._visible(e, state))
                self.local_steps += 1
            self.lives[e].old = now

    def _visible(self, e: int, state) -> np.ndarray:
        """What each robot sees now, bool [N, F] in the map's order."""
        order = self.env.bank.order_free[state["map_id"][e]]
        count = state["visible_count"][e]
        listed = np.arange(state["visible"].shape[2]) < count[:, None]
        now = np.zeros((self.env.num_robots, len(order)), bool)
        robots, slots = np.nonzero(listed)
        now[robots, order[state["visible"][e][robots, slots]]] = True
        assert now.sum() == count.sum(), "a point is listed twice"
        return now

    def _begin(self, e: int, now: dict, state) -> None:
        env, place = self.env, self.places[state["map_id"][e]]
        robots = env.num_robots
        total = int(env.simulation.map_tensors["total_weight"][state["map_id"][e]])
        seen = np.zeros((robots, len(place.free)), bool)
        life = self.lives[e] = Life(place, total, int(state["episode"][e]), seen)
        life.milestone = [(-1, 0.0, np.zeros(robots, np.float32))] * 3
        life.terms, life.total = np.zeros((robots, len(COUNTED))), np.zeros(robots)
        self.episodes += 1
        assert now["local_step"] == 0 and not now["collided"].any() and not now["path_length"].any()
        assert not now["pose"][:, 2].any() and not now["slip"].any(), "robots start at rest"
        need = CLEAR_START * np.array([r.collision_threshold for r in env.robot_configs])
        at = now["center"][:, :2].astype(float)
        if place.walls is not None:
            assert (place.walls.query(at)[0] >= need - NEAR).all(), "a start too near to a wall"
        apart = _distances(at)
        assert (apart >= np.maximum(need[:, None], need[None]) - NEAR).all(), "starts too near to each other"
        visible = self._visible(e, state)
        self._check_scan(life, now, visible)
        life.seen |= visible
        self._cover(life, now)
        life.centers = [at]

    def _follow(self, e: int, now: dict, visible: np.ndarray) -> None:
        life, old = self.lives[e], self.lives[e].old
        assert now["local_step"] == old["local_step"] + 1
        self._check_motion(now, old)
        self._check_collisions(life, now, old)
        self._check_scan(life, now, visible)
        self._count(life, now, old, visible)
        life.centers.append(now["center"][:, :2].astype(float))

    def _check_motion(self, now: dict, old: dict) -> None:
        for name in ("pose", "slip", "center", "path_length"):
            assert np.isfinite(now[name]).all(), f"{name} is not finite"
        speed = np.hypot(now["pose"][:, 2], now["slip"])
        limit = np.array([r.max_speed for r in self.env.robot_configs])
        assert (speed <= limit * (1 + 1e-5)).all(), "faster than the robot's limit"
        assert (np.abs(now["pose"][:, 3]) <= math.pi + 1e-5).all()
        moved = np.hypot(*(now["pose"][:, :2].astype(float) - old["pose"][:, :2]).T)
        driven = now["path_length"].astype(float) - old["path_length"]
        slack = NEAR + 1e-6 * now["path_length"]
        assert (np.abs(moved - driven) <= slack).all(), "path_length is not the way driven"
        assert (moved <= limit * DT + NEAR).all()

    def _check_collisions(self, life: Life, now: dict, old: dict) -> None:
        dead, hit = old["collided"] != 0, now["collided"] != 0
        assert hit[dead].all(), "a collided robot came back"
        for name in ("pose", "center", "path_length"):
            assert np.array_equal(now[name][dead], old[name][dead]), f"{name} of a collided robot changed"
        assert np.array_equal(now["crashed"] != 0, hit & ~dead)
        assert not now["pose"][hit, 2].any() and not now["slip"][hit].any(), "a collided robot has a speed"
        gap = self._footprint_gaps(life, now) if self.env.collision == "footprint" else self._centre_gaps(life, now)
        assert (gap[~hit] >= -NEAR).all(), "a robot inside an obstacle or another robot has not collided"
        assert (gap[hit & ~dead] <= NEAR).all(), "a robot collided with nothing"
        self.crashes += int((hit & ~dead).sum())

    def _centre_gaps(self, life: Life, now: dict) -> np.ndarray:
        """By how much every robot keeps its threshold from boundary points and other centres [m], [N]."""
        at = now["center"][:, :2].astype(float)
        nearest = _distances(at).min(1)
        if life.place.walls is not None:
            nearest = np.minimum(nearest, life.place.walls.query(at)[0])
        return nearest - [r.collision_threshold for r in self.env.robot_configs]

    def _footprint_gaps(self, life: Life, now: dict) -> np.ndarray:
        """How far a boundary point or another body is outside of every robot's body [m], [N]; negative: inside."""
        configs = self.env.robot_configs
        sizes = [(r.length, r.width) for r in configs]
        reach = [0.5 * math.hypot(*size) for size in sizes]
        at = now["center"][:, :2].astype(float)
        rears = [rear_state(pose, r.length, r.kind) for pose, r in zip(now["pose"], configs, strict=True)]
        gap = np.full(len(at), np.inf)
        for i, (x, theta) in enumerate(zip(at, now["pose"][:, 3].astype(float), strict=True)):
            if life.place.walls is not None:
                near = life.place.boundary[life.place.walls.query_ball_point(x, reach[i] + NEAR)] - x
                c, s = math.cos(theta), math.sin(theta)
                along, across = np.abs(near @ [c, s]), np.abs(near @ [-s, c])
                out = np.maximum(along - 0.5 * sizes[i][0], across - 0.5 * sizes[i][1])
                gap[i] = out.min(initial=np.inf)
            for j in range(len(at)):
                if i != j and math.dist(x, at[j]) <= reach[i] + reach[j] + NEAR:
                    gap[i] = min(gap[i], body_separation(rears[i], sizes[i], rears[j], sizes[j]))
        return gap

    def _check_scan(self, life: Life, now: dict, visible: np.ndarray) -> None:
        for i, radar in enumerate(self.env.radar_configs):
            ray = life.place.free[visible[i]] - now["center"][i, :2].astype(float)
            far = np.hypot(*ray.T)
            assert (far <= radar.range * (1 + 1e-5) + NEAR).all(), "a point out of range is seen"
            if radar.fov < 2 * math.pi - 1e-6:
                theta = float(now["pose"][i, 3])
                off = np.abs(np.angle(np.exp(1j * (np.arctan2(ray[:, 1], ray[:, 0]) - theta))))
                assert ((off <= 0.5 * radar.fov + 2e-3) | (far < 10 * NEAR)).all(), "a point out of view is seen"

    def _count(self, life: Life, now: dict, old: dict, visible: np.ndarray) -> None:
        """Coverage, reward terms and milestones of this local step, by counting flags."""
        env, weight = self.env, life.place.weight
        cfg, total = env.settings.reward, life.place.weight.sum()
        before = life.covered / total
        team = life.seen.any(0)
        found = (visible & ~team) @ weight
        overlap = (visible & (visible.sum(0) > 1)) @ weight
        life.seen |= visible
        reached = life.coverage
        self._cover(life, now)
        w, v = cfg.points / total, cfg.events or cfg.points / len(weight)
        left = env.local_steps * env.macro_steps - now["local_step"] if cfg.charge_rest else 0
        if life.coverage >= np.float32(env.success_coverage) or not now["collided"].all():
            left = 0  # the rest is charged when the last robot has collided
        after = life.covered / total
        lapse = -(before + left * after) if cfg.time_on == "covered" else before - 1.0 + left * (after - 1.0)
        if cfg.time_on == "gained":
            rest = env.local_steps * env.macro_steps - now["local_step"]
            over = life.coverage >= np.float32(env.success_coverage) > reached
            lapse = rest * (after - before + over * (1.0 - after + cfg.unfinished))
        won = reached < np.float32(env.success_coverage) <= life.coverage
        life.terms += np.stack(
            [
                w * cfg.explore * found,
                -w * cfg.overlap * overlap * (1 + left),
                np.full(len(found), v * cfg.time * lapse),
                np.full(len(found), v * cfg.success * won),
                -v * cfg.collision * (now["crashed"] != 0),
            ],
            axis=1,
        )
        self.successes += int(won)
        for k, mark in enumerate((0.85, 0.95, 0.99)):
            if life.milestone[k][0] < 0 and life.coverage >= np.float32(mark):
                shared = weight[life.seen.sum(0) > 1].sum() / life.covered
                life.milestone[k] = (int(now["local_step"]), shared, now["path_length"].copy())
        life.over = life.coverage >= np.float32(env.success_coverage) or bool(now["collided"].all())

    def _cover(self, life: Life, now: dict) -> None:
        life.covered = float(life.place.weight[life.seen.any(0)].sum())
        life.coverage = np.float32(now["covered"]) / np.float32(life.total_weight)
        share = life.covered / life.place.weight.sum()
        assert math.isclose(life.coverage, share, rel_tol=1e-6 if life.place.exact else 0.04)

    # Every macro step

    def check_step(self, td) -> None:
        """Compare what `env.step` handed out (`td["next"]`) with what was counted."""
        for e in range(self.env.num_envs):
            life, after = self.lives[e], td["next"][e]
            running = not life.finished
            life.macro_steps += running
            self._check_reward(life, after)
            self._check_info(e, life, after)
            flags = {name: bool(after[name]) for name in ("done", "terminated", "truncated")}
            assert flags["terminated"] == life.over
            assert flags["truncated"] == (life.macro_steps >= self.env.macro_steps and not life.over)
            assert flags["done"] == (flags["terminated"] or flags["truncated"])
            self._check_flags(e, life)
            self._check_observation(e, after)
            life.finished = flags["done"]
            life.terms[:] = 0.0

    def _check_reward(self, life: Life, after) -> None:
        info = after["info"]
        parts = np.stack([info[f"reward_{term}"].cpu().numpy() for term in REWARD_TERMS], axis=1)
        reward = after["agents", "reward"][:, 0].cpu().numpy()
        loose = 1e-4 if life.place.exact else 0.1
        np.testing.assert_allclose(reward, parts.sum(1), rtol=1e-5, atol=1e-5, err_msg="reward is not its terms' sum")
        assert REWARD_TERMS[: len(COUNTED)] == COUNTED
        np.testing.assert_allclose(parts[:, : len(COUNTED)], life.terms, rtol=loose, atol=1e-4, err_msg="terms")
        life.total += reward
        np.testing.assert_allclose(info["episode_reward"].cpu().numpy(), life.total, rtol=1e-4, atol=1e-3)

    def _check_info(self, e: int, life: Life, after) -> None:
        info, now = after["info"], life.old
        assert float(info["coverage"]) == life.coverage and 0.0 < life.coverage <= 1.0
        assert int(info["local_steps"]) == now["local_step"]
        assert np.array_equal(info["collided"].cpu().numpy(), now["collided"] != 0)
        assert np.array_equal(info["path_length"].cpu().numpy(), now["path_length"])
        for (step, shared, paths), mark in zip(life.milestone, ("85", "95", "99"), strict=True):
            assert int(info[f"coverage_step_{mark}"]) == step
            overlap = float(info[f"mutual_overlap_{mark}"])
            assert 0.0 <= overlap <= 1.0 and math.isclose(overlap, shared, abs_tol=1e-5 if life.place.exact else 0.04)
            assert np.array_equal(info[f"path_length_{mark}"].cpu().numpy(), paths)
        steps = [step for step, *_ in life.milestone]
        for first, second in itertools.pairwise(steps):
            assert second == -1 or 0 < first <= second
        for value in after.values(True, True):
            assert not value.is_floating_point() or bool(value.isfinite().all()), "a value is not finite"

    def _check_flags(self, e: int, life: Life) -> None:
        """The env's flags are the points counted, all of them in range of a place the robot has been at."""
        env, state, place = self.env, self.env.simulation.tensors, life.place
        shot = env.snapshot(e)
        assert np.array_equal(shot["seen_free"], life.seen), "flags are not what was seen"
        track = np.stack(life.centers)
        for i, radar in enumerate(env.radar_configs):
            been = cKDTree(track[:, i])
            for points, flags in ((place.free, shot["seen_free"]), (place.boundary, shot["seen_boundary"])):
                far = been.query(points[flags[i]], distance_upper_bound=radar.range * (1 + 1e-5) + NEAR)[0]
                assert np.isfinite(far).all(), "a point is explored that was never in range"
        if env.comm_config.limited:
            count = len(place.free)
            known = unpack_flags(state["known_free"][e : e + 1, :, :count], env.num_robots)[0].cpu().numpy()
            seen = unpack_flags(state["seen_free"][e : e + 1, :, :count], env.num_robots)[0].cpu().numpy()
            assert (known | ~seen).all(), "a robot does not know what it has seen"
            assert (seen.any(0) | ~known).all(), "a robot knows what nobody has seen"

    def _check_observation(self, e: int, td) -> None:
        env, life = self.env, self.lives[e]
        seen = {name: value.cpu().numpy() for name, value in td["agents", "observation"].items()}
        team = td["team", "map"].cpu().numpy()
        at = life.old["center"][:, :2].astype(float)
        assert np.isin(seen["map"][:, :2], (0, 255)).all() and np.isin(seen["map"][:, 2], (0, 128, 255)).all()
        assert np.isin(team[:2], (0, 255)).all() and (team[2] <= env.num_robots).all()
        assert np.array_equal(team[2] > 0, team[0] > 0), "an explored pixel without a robot that explored it"
        assert (np.abs(seen["pose"][:, 2:]) <= 1.0 + 1e-5).all()  # the length of two speeds is rounded
        if self.tight:
            assert (np.abs(seen["pose"][:, :2]) <= 1.0).all() and (np.abs(seen["grid"]) <= 1.0).all()
        assert np.allclose(seen["time_left"], 1.0 - life.macro_steps / env.macro_steps, atol=1e-6)
        assert np.array_equal(seen["alive"], life.old["collided"] == 0)
        self._check_comm(life, seen["comm"], at)
        self._check_picture(life, seen["map"], team, at)

    def _check_comm(self, life: Life, comm: np.ndarray, at: np.ndarray) -> None:
        cfg = self.env.comm_config
        assert comm.diagonal().all() and np.array_equal(comm, comm.T)
        apart = _distances(at)
        near = (apart <= cfg.range) | np.eye(len(at), dtype=bool)
        unsure = (apart > cfg.range - NEAR) & (apart < cfg.range + NEAR)
        assert (near | unsure | ~comm).all(), "a robot hears one out of range"
        if not cfg.line_of_sight:
            assert (comm | unsure | ~near).all(), "a robot does not hear one in range"

    def _check_picture(self, life: Life, picture: np.ndarray, team: np.ndarray, at: np.ndarray) -> None:
        """Every pixel that a free point falls into tells whether one of its points was seen."""
        origin, size = life.place.frame
        where = (life.place.free - origin) / size + 0.5
        sure = (np.abs(where - np.rint(where)) > 1e-3).all(1)
        x, y = np.floor(where).astype(int).clip(0, PIXELS - 1).T
        split = np.zeros((PIXELS, PIXELS), bool)
        for dx in (0, -1):  # pixels that points on an edge may fall into decide nothing
            for dy in (0, -1):
                split[(x + dx)[~sure], (y + dy)[~sure]] = True
        asked = np.zeros((PIXELS, PIXELS), bool)
        asked[x[sure], y[sure]] = True
        asked &= ~split

        def compare(flags: np.ndarray, drawn: np.ndarray) -> None:
            want = np.zeros((PIXELS, PIXELS), bool)
            want[x[flags], y[flags]] = True
            assert np.array_equal(drawn[asked] > 0, want[asked]), "a pixel does not show what was seen"

        compare(life.seen.any(0), team[0])
        for i, (px, py) in enumerate(np.floor((at - origin) / size + 0.5).astype(int)):
            if self.env.observation_config.map == "seen":
                compare(life.seen[i], picture[i, 0])
            around = np.s_[max(px - 1, 0) : px + 2, max(py - 1, 0) : py + 2]
            if 0 <= px < PIXELS and 0 <= py < PIXELS:
                assert (picture[i, 2][around] == 255).any() and (picture[i, 3][around] == 255).any()


def _place(m) -> Place:
    weight = m.free_spacing.astype(float) ** 2
    weight = 16.0 * weight / weight.min()
    (x0, y0), (x1, y1) = m.extent
    side = 1.1 * max(x1 - x0, y1 - y0)
    pixel = side / PIXELS
    corner = np.array([x0 + x1, y0 + y1]) / 2 - side / 2 + pixel / 2
    walls = cKDTree(m.boundary[:, :2]) if len(m.boundary) else None
    exact = np.allclose(weight, np.rint(weight), atol=1e-3)
    return Place(m.free[:, :2].astype(float), m.boundary[:, :2].astype(float), weight, exact, walls, (corner, pixel))


def _distances(at: np.ndarray) -> np.ndarray:
    """Distances between places [m], infinite to themselves, [N, N]."""
    apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    return apart
