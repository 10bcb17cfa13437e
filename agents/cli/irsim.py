"""`maexp irsim`: a team on a floor in the simulator ir-sim, beside the same team in ours."""

import importlib.util
from dataclasses import asdict
from pathlib import Path

import numpy as np

from maexp.agents.cli import Command
from maexp.agents.config.verbs import IrsimSettings
from maexp.agents.errors import UserError, blame_input
from maexp.agents.files import write_json
from maexp.agents.policies.registry import find_named_policy
from maexp.envs import PointCloudMap
from maexp.envs.render.video import write_gif
from maexp.envs.scenarios import default_macro_steps, find_scenario

FILM_SPEED = 4.0  # frames a second; one a decision


def check(cfg: IrsimSettings) -> None:
    """Raise UserError for what is missing, before a folder is made."""
    if not cfg.floor:
        raise UserError("maexp irsim needs a floor after it: a floor plan, a scan or a saved map.")
    from maexp.agents.deploy.irsim.policies import check_player

    check_player(cfg.policy, find_named_policy(cfg.policy))
    if importlib.util.find_spec("irsim") is None:
        raise UserError('maexp irsim needs the simulator ir-sim: pip install "maexp[irsim]".')


def run(cfg: IrsimSettings, where: Path, overrides: list[str]) -> int:
    """Play the trial, then the same in our simulator; write what happened."""
    from maexp.agents.build import import_file
    from maexp.agents.deploy.irsim import policies
    from maexp.agents.deploy.irsim.policies import make_planner
    from maexp.agents.deploy.irsim.trial import run_trial
    from maexp.agents.deploy.irsim.video import draw_curves, draw_moment

    with blame_input():
        world = import_file(cfg.floor, cfg.importing)
        config = make_config(cfg, world)
        player = find_named_policy(cfg.policy)
        env = policies.make_team(world, cfg.num_robots, config, player.targets or 0)
        starts = policies.draw_starts(env, cfg.episode)
        frames: list[np.ndarray] = []
        planner = make_planner(cfg.policy, player, config, env, where)
        trial = run_trial(
            world, planner, starts, config, lambda inputs: frames.append(draw_moment(inputs, config.body_radius))
        )
    curves = {"ir-sim": trial.coverage}
    rows = {"ir-sim": measure(trial.coverage, config.seconds) | {"collisions": int(trial.collided.sum())}}
    if cfg.ours:
        curve, collided = policies.run_ours(env, player.make(env), cfg.episode)
        curves["ours"] = curve
        rows["ours"] = measure(curve, config.seconds) | {"collisions": int(collided.sum())}
    rows["ir-sim"] |= {
        "path_length": trial.path.tolist(),
        "map_errors": trial.errors,
        "drift": trial.drift,
        "done_at": trial.done_at,
    }
    print_rows(rows)
    for note in trial.notes:
        print(f"planner: {note}")
    run_info = {"floor": cfg.floor, "policy": cfg.policy, "num_robots": cfg.num_robots, "episode": cfg.episode}
    content = {"run": run_info | asdict(config), "results": rows, "coverage": curves, "notes": trial.notes}
    write_json(where / "results.json", content)
    title = f"{world.name}: {cfg.num_robots} robots, {player.name}"
    written = [where / "results.json", draw_curves(curves, title, where / "coverage.png")]
    written.append(write_gif(frames, where / "film.gif", FILM_SPEED))
    print(f"Written: {', '.join(str(path) for path in written)}")
    return 0


def make_config(cfg: IrsimSettings, world: PointCloudMap):
    """The trial of these settings; what is not given is that of the floor's scenario."""
    from maexp.agents.deploy.irsim.config import TOLERANCE, TrialConfig
    from maexp.kernels.constants import DT

    scenario = find_scenario(world.scenario)
    team = [(scenario.max_speed, cfg.radar_range or scenario.radar_range)] * cfg.num_robots
    steps = scenario.macro_steps or default_macro_steps([world], scenario, team)
    # Our simulator measures from the points of walls, the middles of cells that are solid here.
    clearance = scenario.collision_threshold - 0.5 * world.resolution if cfg.clearance is None else cfg.clearance
    return TrialConfig(
        seconds=steps * scenario.local_steps * DT if cfg.seconds is None else cfg.seconds,
        radar_range=scenario.radar_range if cfg.radar_range is None else cfg.radar_range,
        max_speed=scenario.max_speed,
        max_accel=scenario.max_accel,
        body_radius=max(clearance - TOLERANCE, 0.5 * clearance) if cfg.body_radius is None else cfg.body_radius,
        clearance=clearance,
        decide=scenario.decision_steps() * DT,
        beams=cfg.beams,
        cell=cfg.cell,
        range_noise=cfg.range_noise,
        pose_noise=cfg.pose_noise,
        pose_drift=cfg.pose_drift,
        people=cfg.people,
        seed=cfg.seed,
    )


def measure(curve: list[float], seconds: float) -> dict[str, float | None]:
    """Coverage at the end and on average over the time, and when 85 and 95 % were seen [s]; None: never."""
    from maexp.kernels.constants import DT

    values = np.array(curve)
    whole = np.concatenate([values, np.full(max(round(seconds / DT) + 1 - len(values), 0), values[-1])])
    result: dict[str, float | None] = {"coverage": float(values[-1]), "coverage_auc": float(whole.mean())}
    for mark in (85, 95):
        reached = np.flatnonzero(values >= mark / 100)
        result[f"seconds_{mark}"] = float(reached[0] * DT) if len(reached) else None
    return result


def print_rows(rows: dict[str, dict]) -> None:
    """One line a simulator."""
    print(f"{'simulator':<11}{'seen':>8}{'mean':>8}{'85 % at':>10}{'95 % at':>10}{'collisions':>12}")
    for name, row in rows.items():
        marks = ["never" if row[f"seconds_{mark}"] is None else f"{row[f'seconds_{mark}']:.1f} s" for mark in (85, 95)]
        print(
            f"{name:<11}{row['coverage']:>8.1%}{row['coverage_auc']:>8.1%}{marks[0]:>10}{marks[1]:>10}"
            f"{row['collisions']:>12}"
        )


COMMAND = Command(run, check)
