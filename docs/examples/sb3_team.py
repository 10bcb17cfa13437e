"""What sb3_train.py has learned, as a policy of MAexp: `maexp evaluate policy=sb3_team:make`."""

import torch
from sb3_contrib import MaskablePPO


def make(env):
    model = MaskablePPO.load("sb3_model.zip", device="cpu")
    names = {"action_mask": "targets_mask"} | {name: name for name in model.observation_space if name != "action_mask"}

    def choose(tensordict):
        seen = tensordict["agents", "observation"].flatten(0, 1)  # robots of all teams, one after the other
        robots = {name: seen[key].numpy().astype(model.observation_space[name].dtype) for name, key in names.items()}
        robots = {name: robot.reshape(-1, *model.observation_space[name].shape) for name, robot in robots.items()}
        chosen, _ = model.predict(robots, action_masks=robots["action_mask"].astype(bool), deterministic=True)
        tensordict["agents", "action", "target"] = torch.as_tensor(chosen).view(env.num_envs, env.num_robots)
        return tensordict

    return choose
