"""A team game with the keys of ExplorationEnv, tiny pictures and a known best action.

Each robot's picture shows one bright region, drawn anew at every reset. Choosing it earns 1, and the offset
earns up to 1 more the nearer it is to the target (0.5, -0.5); the best return per step and robot is 2.
Robots that choose the same region share what it pays, so that a team of one picture each has one optimum.
"""

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from maexp.agents.config.model import ModelConfig

SIDE = 2
PIXELS = 16
OFFSET = (0.5, -0.5)
SMALL_MODEL = ModelConfig(channels=4, grid_features=4, heads=1, feedforward=1, critic_hidden=8)
TINY_MODEL = ModelConfig(channels=2, grid_features=2, heads=1, feedforward=1, critic_hidden=4)


class ToyEnv(EnvBase):
    """Args: num_envs teams of num_robots; `steps` per episode; `regions` on a side; `picture` pixels a side.

    An env whose `terminal` flag was drawn (half of them) terminates at the end, the others are truncated.
    """

    def __init__(self, num_envs=16, num_robots=3, steps=4, side=SIDE, pixels=PIXELS, control=False, seed=0):
        super().__init__(device="cpu", batch_size=[num_envs])
        self.num_robots, self.steps, self.side, self.pixels, self.control = num_robots, steps, side, pixels, control
        self.generator = torch.Generator().manual_seed(seed)
        lead, team = (num_envs,), (num_envs, num_robots)
        observation = Composite(
            map=Bounded(0, 255, (*team, 4, pixels, pixels), dtype=torch.uint8),
            pose=Unbounded((*team, 4)),
            grid=Unbounded((*team, 4, side, side)),
            comm=Binary(num_robots, shape=(*team, num_robots), dtype=torch.bool),
            time_left=Unbounded((*team, 1)),
            alive=Binary(num_robots, shape=team, dtype=torch.bool),
            shape=team,
        )
        self.observation_spec = Composite(
            agents=Composite(observation=observation, shape=team),
            team=Composite(map=Bounded(0, 255, (*lead, 3, pixels, pixels), dtype=torch.uint8), shape=lead),
            shape=lead,
        )
        region = Categorical(side * side, shape=team, dtype=torch.int64)
        action = (
            {"control": Bounded(-1, 1, (*team, 2))}
            if control
            else {"region": region, "offset": Bounded(-1, 1, (*team, 2))}
        )
        self.action_spec = Composite(agents=Composite(action=Composite(**action, shape=team), shape=team), shape=lead)
        self.reward_spec = Composite(agents=Composite(reward=Unbounded((*team, 1)), shape=team), shape=lead)
        flag = Binary(shape=(*lead, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=lead)
        self.target = torch.zeros(team, dtype=torch.int64)
        self.step_count = torch.zeros(lead, dtype=torch.int64)
        self.terminal = torch.zeros(lead, dtype=torch.bool)

    def _reset(self, tensordict=None):
        mask = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict.keys():
            mask = tensordict["_reset"].reshape(self.batch_size)
        drawn = torch.rand((*self.batch_size, self.side**2), generator=self.generator).argsort(-1)
        robots = torch.arange(self.num_robots) % self.side**2
        self.target = torch.where(mask[:, None], drawn[:, robots], self.target)
        ends = torch.rand(self.batch_size, generator=self.generator) < 0.5
        self.terminal = torch.where(mask, ends, self.terminal)
        self.step_count = torch.where(mask, 0, self.step_count)
        return self._observe()

    def _step(self, tensordict):
        action = tensordict["agents", "action"]
        self.step_count = self.step_count + 1
        aim = torch.tensor(OFFSET)
        if self.control:
            reward = 1 - (action["control"].clamp(-1, 1) - aim).abs().mean(-1)
        else:
            hit = (action["region"] == self.target).float()
            reward = hit + 1 - (action["offset"].clamp(-1, 1) - aim).abs().mean(-1)
        over = (self.step_count >= self.steps).unsqueeze(-1)
        terminated = over & self.terminal.unsqueeze(-1)
        out = self._observe()
        out.update(
            {
                "agents": {"reward": reward.unsqueeze(-1)},
                "done": over,
                "terminated": terminated,
                "truncated": over & ~terminated,
            }
        )
        return out

    def _observe(self):
        team = (*self.batch_size, self.num_robots)
        block = self.pixels // self.side
        lit = torch.nn.functional.one_hot(self.target, self.side**2).unflatten(-1, (self.side, self.side))
        picture = (lit * 255).to(torch.uint8).repeat_interleave(block, -2).repeat_interleave(block, -1)
        pose = torch.zeros(*team, 4)
        pose[..., 0] = torch.linspace(-0.5, 0.5, self.num_robots)
        pose[..., 2] = self.step_count.unsqueeze(-1) / self.steps - 0.5
        line = (torch.arange(self.side) * 2 + 1) / self.side - 1
        place = torch.stack(torch.meshgrid(line, line, indexing="ij"))
        offsets = (place - pose[..., :2, None, None]) / 2
        maps = torch.stack((picture, picture // 2, torch.zeros_like(picture), torch.zeros_like(picture)), dim=2)
        observation = {
            "map": maps,
            "pose": pose,
            "grid": torch.cat((offsets, offsets), dim=2),
            "comm": torch.ones(*team, self.num_robots, dtype=torch.bool),
            "time_left": (1 - self.step_count / self.steps).reshape(-1, 1, 1).repeat(1, self.num_robots, 1),
            "alive": torch.ones(team, dtype=torch.bool),
        }
        agents = TensorDict({"observation": TensorDict(observation, batch_size=team)}, batch_size=team)
        return TensorDict({"agents": agents, "team": {"map": maps.amax(1)[:, :3]}}, batch_size=self.batch_size)

    def _set_seed(self, seed):
        self.generator.manual_seed(seed or 0)
