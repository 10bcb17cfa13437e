"""The radar filter as one dense PyTorch expression, from its definition, and how much slower it is.

`python tests/helpers/dense_radar.py` prints the ratio that `test_bench_radar` compares with its record.
"""

import time

import torch
import warp as wp

from maexp.envs import ExplorationEnv, make_map
from maexp.kernels.step import local_step

LAPS = 15
ENVS = 8


def visible_points(free, obstacles, origin, radar_range, alpha1, alpha2, radius) -> torch.Tensor:
    """Free points seen from `origin`, bool (n_free,): every free point against every obstacle, nothing skipped."""
    free, obstacles = free - origin, obstacles - origin
    range_free, range_obstacle = free.norm(dim=1), obstacles.norm(dim=1)
    cosine = (free @ obstacles.T) / (range_free[:, None] * range_obstacle[None]).clamp_min(1e-30)
    cosine = cosine.clamp(-1.0, 1.0)
    nearer = range_obstacle[None] - range_free[:, None] < alpha2
    in_beam = cosine > 1.0 - alpha1
    behind_disc = cosine.acos() < (radius / range_obstacle.clamp_min(1e-30)).clamp_max(1.0).asin()[None]
    masks = (range_obstacle <= radar_range) & (range_obstacle > 0.0)
    masked = (nearer & (in_beam | behind_disc) & masks[None]).any(1) & (range_free > 0.0)
    return (range_free <= radar_range) & ~masked


class Scene:
    """Lone robots somewhere in a maze, what the kernels see from there, and the dense filter on the same points."""

    def __init__(self, dtype: torch.dtype = torch.float32):
        self.env = ExplorationEnv(make_map("maze_small", 3), num_envs=ENVS, num_robots=1, seed=5, num_threads=1)
        torch.manual_seed(5)
        self.env.rollout(3, break_when_any_done=False)
        place, radar = self.env.maps[0], self.env.radar_configs[0]
        self.free, self.obstacles = (torch.as_tensor(p, dtype=dtype) for p in (place.free, place.boundary))
        self.radius = torch.as_tensor(place.boundary_spacing, dtype=dtype) / 2**0.5
        self.centers = self.env.simulation.tensors["center"][:, 0].to(dtype)
        self.limits = radar.range, radar.alpha1, radar.alpha2
        self.launches = self._radar_launches()

    def dense(self) -> list[torch.Tensor]:
        return [visible_points(self.free, self.obstacles, at, *self.limits, self.radius) for at in self.centers]

    def kernels(self) -> None:
        for command in self.launches:
            command.launch()

    def _radar_launches(self) -> list[wp.Launch]:
        wanted = ("_collect_occluders", "_scan_free")
        return [launch for launch in self.env.simulation.shards[0].record(local_step) if launch.kernel.key in wanted]


def measure_ratio() -> float:
    """Seconds of the dense filter over seconds of the kernels, in turns: processor time of this thread, best laps."""
    scene = Scene()
    best = {}
    for _ in range(LAPS):
        for call, count in ((scene.kernels, 5), (scene.dense, 1)):
            begin = time.thread_time()
            for _ in range(count):
                call()
            lap = (time.thread_time() - begin) / count
            best[call.__name__] = min(lap, best.get(call.__name__, lap))
    return best["dense"] / best["kernels"]


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(f"RECORDED_RATIO = {sorted(measure_ratio() for _ in range(5))[2]:.0f}")
