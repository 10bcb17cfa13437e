"""Films of held-out episodes, and the episodes themselves as files that replay without simulation."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase

from maexp.agents.config.verbs import EvaluateSettings
from maexp.agents.errors import UserError
from maexp.envs import ExplorationEnv
from maexp.envs.render.episode import Episode
from maexp.envs.render.frames import add_headline, draw_frame, draw_grid, watch_episode
from maexp.envs.render.video import write_gif, write_mp4

WRITERS = {"gif": write_gif, "mp4": write_mp4}
EPISODES = "episodes"  # folder of the episode files
LINE = 26  # pixels of a line of the caption
WIDTHS = ((1, 512), (2, 440), (4, 360), (9, 256), (10**9, 176))  # (up to so many teams, pixels of a team's picture)


def check_render(cfg: EvaluateSettings) -> None:
    """Raise UserError where no film could be written at the end."""
    if cfg.render_format not in WRITERS:
        raise UserError(f"render_format={cfg.render_format} is unknown: choose one of {', '.join(WRITERS)}.")
    if cfg.render and cfg.render_envs > cfg.episodes:
        asked = f"render_envs={cfg.render_envs} is more than is played"
        warnings.warn(f"{asked} (episodes={cfg.episodes}): {cfg.episodes} will be filmed", stacklevel=2)
    if cfg.render and cfg.render_format == "mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError as error:
            advice = 'pip install "maexp[video]", or give render_format=gif'
            raise UserError(f"render_format=mp4 needs imageio-ffmpeg: {advice}.") from error


def play_teams(
    env: ExplorationEnv,
    policy: TensorDictModuleBase,
    name: str,
    *,
    first: int = 0,
    teams: Sequence[int] | None = None,
    seed: int = 0,
    every: int | None = None,
) -> list[Episode]:
    """Evaluation episodes `first`, `first` + 1, ... of the teams of `env`, recorded.

    Args:
        teams: numbers of the teams to record; None: all
        policy: a TensorDictModule that writes the action; `name` is what the files call it
        seed: of the policy's random numbers; the global ones go on as if nothing had happened
        every: local steps from one record to the next; None: about 150 records in a full episode
    """
    teams = range(env.num_envs) if teams is None else teams
    recorders = [env.space.EpisodeRecorder(name) for _ in teams]

    def look(snapshots: list[dict]) -> None:
        for recorder, snapshot in zip(recorders, snapshots, strict=True):
            recorder.add(snapshot)

    devices = [env.device] if env.device.type == "cuda" else []
    with torch.random.fork_rng(devices):
        torch.manual_seed(seed)
        env.set_episodes(torch.arange(first, first + env.num_envs, device=env.device))
        watch_episode(env, policy, look, teams, every)
    return [recorder.episode() for recorder in recorders]


def draw_film(episodes: list[Episode], caption: Sequence[str] = (), columns: int | None = None) -> list[np.ndarray]:
    """The pictures of a film, uint8 (height, width, 3): the teams side by side, at the same time each.

    Where policies differ, each team's picture has the name of its own on top. `caption`: lines of text over all.
    """
    several = len({episode.policy for episode in episodes}) > 1
    width = next(pixels for most, pixels in WIDTHS if len(episodes) <= most)
    frames, latest = [], {}
    for step in np.unique(np.concatenate([episode.step for episode in episodes])):
        for k, episode in enumerate(episodes):
            record = int(np.searchsorted(episode.step, step, side="right")) - 1
            if latest.get(k, (-1,))[0] != record:  # a team that is done stands still
                picture = draw_frame(episode.snapshot(record), width)
                latest[k] = record, add_headline(picture, episode.policy) if several else picture
        pictures = [latest[k][1] for k in range(len(episodes))]
        frame = pictures[0] if len(pictures) == 1 else draw_grid(pictures, columns)
        for line in reversed(caption):
            frame = add_headline(frame, line, LINE)
        frames.append(frame)
    return frames


def write_film(episodes: list[Episode], folder: Path, name: str, kind: str) -> list[Path]:
    """Write `film_NAME.KIND` and `episodes/NAME_K.npz`, K counted from 0; returns what was written."""
    path = WRITERS[kind](draw_film(episodes), folder / f"film_{name}.{kind}")
    (folder / EPISODES).mkdir(exist_ok=True)
    return [path] + [episode.save(folder / EPISODES / f"{name}_{k}.npz") for k, episode in enumerate(episodes)]
