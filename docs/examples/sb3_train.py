"""Stable-Baselines3's masked PPO learns to choose among targets: `python sb3_train.py` writes sb3_model.zip."""

import supersuit
from sb3_contrib import MaskablePPO
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor

from maexp.envs import make_map, parallel_env


class Masks(VecEnvWrapper):
    """Passes masks to MaskablePPO: SuperSuit passes on observations, but no methods."""

    def reset(self):
        self.seen = self.venv.reset()
        return self.seen

    def step_wait(self):
        self.seen, *rest = self.venv.step_wait()
        return self.seen, *rest

    def has_attr(self, name):
        return name == "action_masks"

    def env_method(self, name, *args, indices=None, **kwargs):
        return list(self.seen["action_mask"].astype(bool))


team = parallel_env(
    [make_map("maze_small", index) for index in range(4)], num_robots=3, action="targets", macro_steps=15
)
agents = supersuit.pettingzoo_env_to_vec_env_v1(team)
agents = supersuit.concat_vec_envs_v1(agents, num_vec_envs=2, base_class="stable_baselines3")  # 2 teams, 6 agents
agents.venv.reset(seed=1)  # copies of one env have its seed: here each team gets its own
agents = VecMonitor(Masks(agents), info_keywords=("coverage", "collided"))
model = MaskablePPO("MultiInputPolicy", agents, n_steps=15, batch_size=90, gamma=1.0, verbose=1)
model.learn(180)  # 100,000 or more for a real training
model.save("sb3_model.zip")
