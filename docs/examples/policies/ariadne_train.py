"""Train `ariadne.py`: it learns to pick the viewpoint nearest to where an expert would go, first while the expert
drives, then while it drives itself (DAgger, Ross et al. 2011), on maps that no suite has.

    python ariadne_train.py           writes ariadne.npz beside this file: some seven minutes of one core
"""

import sys
import time
from pathlib import Path

import numpy as np
import torch
from ariadne import FEATURES, HEADS, LAYERS, SEES, WIDTH, Ariadne, edges_of
from torch import nn

from maexp.agents import make_env, make_policy
from maexp.agents.policies.remote.numpy_policy import TeamSight

SCENARIOS = ("maze_small", "random_obstacles", "indoor_small", "outdoor")  # their training maps
EXPERT, TEAMS = "cost_utility", 8
ROUNDS, DECISIONS, EPOCHS = 2, 160, 6  # of each scenario in a round [of teams]; after each round
BATCH, RATE, BLUR = 32, 1e-3, 0.3  # BLUR: how near to the expert's goal counts [radar ranges]
REGIONS = 8


class Attention(nn.Module):
    """Of x [B, X, WIDTH] to those of y [B, Y, WIDTH] that `edges` [B, X, Y] allow."""

    def __init__(self):
        super().__init__()
        self.q, self.k, self.v, self.out = (nn.Linear(WIDTH, WIDTH) for _ in range(4))

    def forward(self, x, y, edges):
        q, k, v = (tensor.unflatten(-1, (HEADS, -1)).transpose(1, 2) for tensor in (self.q(x), self.k(y), self.v(y)))
        heard = nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=edges.unsqueeze(1))
        return self.out(heard.transpose(1, 2).flatten(2))


class Net(nn.Module):
    """`ariadne.Network` for many robots at once; each stands at its viewpoint `own` [B]."""

    def __init__(self):
        super().__init__()
        self.embed = nn.Linear(FEATURES, WIDTH)
        self.layers = nn.ModuleList(Attention() for _ in range(LAYERS))
        self.norms = nn.ModuleList(nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(2)) for _ in range(LAYERS))
        self.inner = nn.ModuleList(nn.Linear(WIDTH, 2 * WIDTH) for _ in range(LAYERS))
        self.outer = nn.ModuleList(nn.Linear(2 * WIDTH, WIDTH) for _ in range(LAYERS))
        self.whole, self.point, self.ask = Attention(), nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH)

    def forward(self, features, edges, own):
        x = self.embed(features)
        for layer, norms, inner, outer in zip(self.layers, self.norms, self.inner, self.outer, strict=True):
            x = norms[0](x + layer(x, x, edges))
            x = norms[1](x + outer(torch.relu(inner(x))))
        here = x[torch.arange(len(x)), own].unsqueeze(1)
        there = edges.diagonal(dim1=1, dim2=2).unsqueeze(1)  # viewpoints that there are
        whole = here + self.whole(here, x, there)
        return 10.0 * torch.tanh((self.point(x) * self.ask(whole)).sum(-1) / WIDTH**0.5)

    def save(self, path):
        """As `ariadne.Network` reads it."""
        arrays = {name: value.detach().numpy().astype(np.float16) for name, value in self.state_dict().items()}
        np.savez_compressed(path, **arrays)


def goals_of(env, state):
    """Where an action sends the robots [m], [E, N, 2]."""
    region, offset = state["agents", "action", "region"], state["agents", "action", "offset"]
    number = env.simulation.tensors["map_id"].long()
    low, high = (env.simulation.map_tensors[name][number].unsqueeze(1) for name in ("lower", "upper"))
    middle = torch.stack([region // REGIONS, region % REGIONS], -1) + 0.5
    return (low + (middle + 0.5 * offset) * (high - low) / REGIONS).double().numpy()


def collect(scenario, decisions, weights, seed):
    """(features, edges, own, wanted) of each robot in `decisions` of teams; with `weights` every other team is driven
    by the network, the others by the expert."""
    env = make_env(f"scenario={scenario}", f"num_envs={TEAMS}", f"seed={seed}", "observation.pictures=false")
    expert, sight = make_policy(EXPERT, env), TeamSight(env)
    agents, rows, asked = [Ariadne(weights) for _ in range(TEAMS)], [], 0
    state = env.reset()
    while asked < decisions:
        sight.look()
        state = expert(state)
        theirs, driven = goals_of(env, state), goals_of(env, state)
        for team in np.flatnonzero(sight.active):
            agent, seen, asked = agents[team], sight.observation(team), asked + 1
            if sight.begins[team]:
                agent.reset(sight.episode(team))
            origin, cell = np.asarray(seen["origin"]), seen["resolution"]
            reach, before = agent.episode["radar_range"], len(agent.visited)
            for robot, graph, own, features in agent.look(seen, theirs[team]):
                goals = origin + (graph.goals[:, ::-1] + 0.5) * cell
                away = np.linalg.norm(goals - theirs[team, robot], axis=1) / reach
                wanted = np.exp(-((np.nan_to_num(away, nan=np.inf) - np.nanmin(away, initial=9.0)) ** 2) / BLUR**2)
                if wanted.any():
                    rows.append((features, edges_of(graph), own, np.float32(wanted / wanted.sum())))
            if weights is not None and team % 2:
                del agent.visited[before:]
                driven[team] = agent.act(seen)
        state["agents", "action", "region"], state["agents", "action", "offset"] = sight.to_action(driven)
        state = env.step_and_maybe_reset(state)[1]
    return rows


def batch_of(rows, random):
    """Tensors of some rows, padded to the largest graph, each turned or mirrored at random."""
    size = max(len(features) for features, *_ in rows)
    features, edges = torch.zeros(len(rows), size, FEATURES), torch.zeros(len(rows), size, size, dtype=torch.bool)
    wanted, own = torch.zeros(len(rows), size), torch.tensor([row[2] for row in rows])
    for k, (given, near, _, want) in enumerate(rows):
        count = len(given)
        features[k, :count], edges[k, :count, :count] = torch.from_numpy(given), torch.from_numpy(near)
        wanted[k, :count] = torch.from_numpy(want)
    turn = torch.from_numpy(random.integers(0, 2, (len(rows), 3)))
    away = features[..., :2] * (1 - 2 * turn[:, None, :2])
    features[..., :2] = torch.where(turn[:, None, 2:] == 1, away.flip(-1), away)
    edges |= (~edges.any(-1, keepdim=True)) & (torch.arange(size) == 0)  # rows of padding look at something
    return features, edges, own, wanted


def fit(net, rows, epochs, random):
    """Cross entropy with the viewpoints near to the expert's goal; prints its mean over each epoch, and how often the
    viewpoint liked best is among the wanted ones."""
    batches = len(rows) // BATCH
    optimiser = torch.optim.AdamW(net.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, max(1, batches * epochs))
    by_size = sorted(range(len(rows)), key=lambda k: len(rows[k][0]))
    for epoch in range(epochs):
        told = []
        for k in random.permutation(batches):
            features, edges, own, wanted = batch_of([rows[j] for j in by_size[k * BATCH :][:BATCH]], random)
            liked = net(features, edges, own).masked_fill(features[..., SEES] == 0, -1e9)
            loss = -(wanted * liked.log_softmax(-1)).sum(-1).mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimiser.step()
            schedule.step()
            hit = wanted.gather(1, liked.argmax(1, keepdim=True))[:, 0] > 0.5 * wanted.max(1).values
            told.append((float(loss.detach()), float(hit.float().mean())))
        print(f"epoch {epoch + 1}: loss {np.mean(told, 0)[0]:.3f}, as the expert {np.mean(told, 0)[1]:.2f}", flush=True)


def main(path):
    torch.manual_seed(0)
    torch.set_num_threads(1)
    random, net, rows, begin = np.random.default_rng(0), Net(), [], time.process_time()
    for number in range(ROUNDS):
        for k, scenario in enumerate(SCENARIOS):
            rows += collect(scenario, DECISIONS, path if number else None, 1000 * number + k)
            print(f"{scenario}: {len(rows)} choices, {time.process_time() - begin:.0f} s", flush=True)
        fit(net, rows, EPOCHS, random)
        net.save(path)
    print(f"{path}: {path.stat().st_size / 1024:.0f} KiB, {time.process_time() - begin:.0f} s of processor time")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("ariadne.npz"))
