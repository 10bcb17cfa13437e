"""Checkouts compared in turns, so that whatever else the machine does meets all alike (docs/performance.md).

`python tests/tools/turns.py steps FOLDER ... -- scenario=maze planner=wavefront goals=cost_utility robots=3 threads=1`
prints processor time of a robot-local-step and of a decision of a team, 64 teams. `python tests/tools/turns.py training
FOLDER ... -- num_envs=64` prints wall and processor seconds of an iteration of `maexp train` with these settings, for
480 macro steps of teams; OMP_NUM_THREADS=1 and num_threads=1 make it one thread. Medians of nine turns.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

TURNS, TEAMS, MACRO_STEPS = 9, 64, 480


def make_stepper(scenario="maze", planner="wavefront", goals="random", robots="3", threads="1") -> Callable[[], dict]:
    from maexp.agents.policies import POLICIES
    from maexp.envs import ExplorationEnv, PlannerConfig, make_map

    maps, count = [make_map(scenario, k) for k in range(8)], int(robots)
    env = ExplorationEnv(maps, TEAMS, count, planner=PlannerConfig(name=planner), num_threads=int(threads), seed=1)
    choose, td = env.rand_action if goals == "random" else POLICIES[goals](env), env.reset()

    def turn() -> dict[str, float]:
        nonlocal td
        begin = time.process_time()
        td = choose(td)
        chosen = time.process_time()
        td = env.step_and_maybe_reset(td)[1]
        step = (time.process_time() - chosen) / (TEAMS * count * env.local_steps)
        return {"step [us]": 1e6 * step, "decision [ms]": 1e3 * (chosen - begin) / TEAMS}

    return turn


def make_trainer(*overrides: str) -> Callable[[], dict]:
    from maexp.agents.benchmarks.throughput.train import Trainee
    from maexp.agents.config.compose import compose_settings

    trainee = Trainee.build(compose_settings("train", list(overrides)))
    share = MACRO_STEPS / (trainee.env.num_envs * trainee.cfg.collector.steps)

    def turn() -> dict[str, float]:
        begin = time.process_time()
        trainee.iterate()
        laps = trainee.laps[-1] | {"processor": time.process_time() - begin}
        return {f"{name} [s]": share * seconds for name, seconds in laps.items()}

    return turn


def serve(kind: str, settings: list[str]) -> None:
    """A turn for every line that comes in, after one that warms up."""
    turn = (
        make_stepper(**dict(setting.split("=") for setting in settings)) if kind == "steps" else make_trainer(*settings)
    )
    turn()
    for _ in range(TURNS):
        print("ready", flush=True)
        sys.stdin.readline()
        print(json.dumps(turn()), flush=True)


def compare(kind: str, folders: list[str], settings: list[str]) -> None:
    runs, laps = [], [[] for _ in folders]
    with tempfile.TemporaryDirectory() as place:
        for k, folder in enumerate(folders):
            (Path(place) / str(k)).mkdir()
            (Path(place) / str(k) / "maexp").symlink_to(Path(folder).resolve())
            words = [sys.executable, str(Path(__file__).resolve()), "serve", kind, *settings]
            there = os.environ | {"PYTHONPATH": f"{place}/{k}"}
            runs.append(subprocess.Popen(words, env=there, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
            runs[-1].stdout.readline()  # each warms up by itself
        for turn in range(TURNS):
            for run, mine in zip(runs, laps, strict=True):
                run.stdin.write("\n")
                run.stdin.flush()
                mine.append(json.loads(run.stdout.readline()))
                if turn < TURNS - 1:
                    run.stdout.readline()
        for run in runs:
            run.wait()
    for folder, mine in zip(folders, laps, strict=True):
        print(folder, *(f"{name} {statistics.median(lap[name] for lap in mine):.3f}" for name in mine[0]), sep="  ")


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(sys.argv[2], sys.argv[3:])
    else:
        end = sys.argv.index("--")
        compare(sys.argv[1], sys.argv[2:end], sys.argv[end + 1 :])
