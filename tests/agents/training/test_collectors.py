"""Where experience comes from: teams of several sizes, worker processes, two devices, Ray."""

import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from multiprocessing import active_children, reduction
from pathlib import Path

import pytest
import torch
from metrics_file import read_metrics

from maexp.agents.build import load_maps
from maexp.agents.cli import main
from maexp.agents.config.compose import compose_settings
from maexp.agents.config.overrides import make_overrides
from maexp.agents.errors import UserError
from maexp.agents.training.checkpoint import find_checkpoint
from maexp.agents.training.collectors import Teams, WorkerLost, batch_statistics, divide_teams
from maexp.agents.training.logs import tag
from maexp.agents.training.prepare import make_both
from maexp.envs import ExplorationEnv, make_map
from maexp.envs.metrics import episode_metrics

pytestmark = pytest.mark.slow  # processes, Ray

ROBOTS, STEPS = 2, 5


def play(first: int, count: int) -> list[torch.Tensor]:
    """What teams `first` to `first + count` - 1 of 8 see and earn, over resets, all taking planned actions."""
    env = ExplorationEnv(
        [make_map("maze_small", 0), make_map("maze_small", 1)],
        num_envs=count,
        num_robots=ROBOTS,
        seed=3,
        local_steps=4,
        macro_steps=2,
        num_threads=1,
        first_env=first,
    )
    plan = torch.Generator().manual_seed(1)
    regions = torch.randint(64, (STEPS, 8, ROBOTS), generator=plan)[:, first : first + count]
    td, seen = env.reset(), []
    for region in regions:
        td["agents", "action", "region"] = region
        td["agents", "action", "offset"] = torch.zeros(count, ROBOTS, 2)
        stepped, td = env.step_and_maybe_reset(td)
        seen += [stepped["next", "agents", "reward"], td["agents", "observation", "map"]]
    return seen


def test_two_envs_of_four_teams_play_what_one_of_eight_plays():
    whole, halves = play(0, 8), (play(0, 4), play(4, 4))
    for tensor, *parts in zip(whole, *halves, strict=True):
        assert torch.equal(tensor, torch.cat(parts))
    assert not torch.equal(halves[0][1], halves[1][1]), "the halves must not repeat each other"
    with pytest.raises(ValueError, match="first_env=-1"):
        play(-1, 4)


def test_teams_are_shared_among_sizes_and_workers():
    assert divide_teams(8, [3]) == [Teams(3, 8, 0)]
    for count, sizes, workers in ((32, [2, 3, 4], 1), (32, [2, 3, 4], 2), (9, [1, 5], 3), (6, [4, 1, 2], 2)):
        teams = divide_teams(count, sizes, workers)
        numbers = [team.first_env + k for team in teams for k in range(team.num_envs)]
        assert numbers == list(range(count)), "every team once"
        assert [team.num_robots for team in teams] == sizes
        counts = [team.num_envs for team in teams]
        assert max(counts) - min(counts) <= workers and all(number % workers == 0 for number in counts)
        shares = teams[-1].split(workers)
        assert len({share.num_envs for share in shares}) == 1 and shares[-1].first_env + shares[-1].num_envs == count
    with pytest.raises(UserError, match="num_envs=7 cannot be shared evenly by collector.workers=2"):
        divide_teams(7, [3], 2)
    with pytest.raises(UserError, match="num_envs=4 is too few for 3 team sizes .* choose 6 or more"):
        divide_teams(4, [2, 3, 4], 2)


def test_statistics_of_several_sizes_are_those_of_all_robots_and_episodes():
    envs = [
        ExplorationEnv(make_map("maze_small", 0), num_envs=n, num_robots=robots, local_steps=4, macro_steps=m)
        for n, robots, m in ((3, 1, 2), (2, 3, 4))
    ]
    torch.manual_seed(0)
    batches = [env.rollout(4, break_when_any_done=False) for env in envs]
    alive = batches[1]["agents", "observation", "alive"]
    alive[0, 2:, 0] = False  # as if one robot had collided: it earns without deciding
    found = batch_statistics(*batches)
    robots = [reward for b in batches for reward in b["next", "agents", "reward"].flatten().tolist()]
    assert len(robots) == 3 * 4 * 1 + 2 * 4 * 3
    assert found["reward"] == pytest.approx(sum(robots) / (len(robots) - 2), rel=1e-5)
    times = [term for b in batches for term in b["next", "info", "reward_time"].flatten().tolist()]
    assert found["reward_time"] == pytest.approx(sum(times) / (len(robots) - 2), rel=1e-5)
    ends = [b["next"][e, t] for b in batches for e, t in grid(*b.shape) if bool(b["next", "done"][e, t])]
    assert found["episodes"] == len(ends) == 3 * 2 + 2 * 1
    for name, value in (
        ("coverage", lambda end: float(end["info", "coverage"])),
        ("collisions", lambda end: float(end["info", "collided"].sum())),
        ("path_length", lambda end: float(end["info", "path_length"].mean())),
    ):
        assert found[name] == pytest.approx(sum(map(value, ends)) / len(ends), rel=1e-5)


def test_a_team_whose_last_robot_collides_in_the_step_of_success_has_succeeded():
    """The log of a training counts as the evaluation does: what was covered, whatever became of the robots."""
    env = ExplorationEnv(make_map("maze_small", 0), 2, 2, local_steps=4, macro_steps=2, success_coverage=0.3)
    torch.manual_seed(0)
    batch = env.rollout(2)
    info = batch["next", "info"]
    info["coverage"][:, -1, 0] = torch.tensor([0.3, 0.29])  # float32: 0.3 as the kernels round it
    info["collided"][:, -1] = True
    batch["next", "terminated"][:, -1] = True
    final = episode_metrics(info[:, -1], success_coverage=0.3)["success_rate"]
    assert final.tolist() == [1.0, 0.0]
    assert batch_statistics(batch, success_coverage=0.3)["success_rate"] == 0.5


def grid(*sizes: int) -> list[tuple]:
    return [tuple(place.tolist()) for place in torch.cartesian_prod(*map(torch.arange, sizes))]


# Worker processes

TINY = [
    "action=regions",
    "scenario.maps=[0,1]",
    "scenario.held_out=[70]",
    "scenario.macro_steps=3",
    "scenario.local_steps=5",
    "num_envs=4",
    "num_robots=2",
    "collector.steps=2",
    "checkpoint_every=2",
    "episodes=0",
    "device=cpu",
    "evaluate_every=0",
]
BATCH = 8


@pytest.fixture
def make_experience():
    """A function from settings to (learner, experience); the workers end with the test."""
    made = []

    def make(*words: str):
        torch.manual_seed(0)
        cfg = compose_settings("train", make_overrides("train", [*TINY, *words]))
        learner, experience = make_both(cfg, load_maps(cfg.scenario).train)
        made.append(experience)
        return learner, experience

    yield make
    for experience in made:
        experience.shutdown()


def differing(first, second) -> set[str]:
    """The entries in which two lists of batches are not the same bits; the rest is TorchRL's."""
    return {
        str(key)
        for a, b in zip(first, second, strict=True)
        for key in a.exclude("collector").keys(True, True)
        if not torch.equal(a[key], b[key])
    }


def change(policy) -> None:
    """Weights that act quite differently."""
    with torch.no_grad():
        for p in policy.parameters():
            p.add_(torch.randn(p.shape, generator=torch.Generator().manual_seed(1)))


@pytest.fixture
def handed_over(monkeypatch) -> list[int]:
    """Sizes [bytes] of what is written to worker processes as they start."""
    sizes, dump = [], reduction.dump

    def record(thing, file, *rest):
        dump(thing, file, *rest)
        sizes.append(file.tell())

    monkeypatch.setattr(reduction, "dump", record)
    return sizes


def test_two_workers_gather_what_their_teams_see_and_a_killed_one_is_named(make_experience, handed_over):
    learner, experience = make_experience("collector=processes")
    assert 0 < max(handed_over) < 2**16, "more would wait for ever on a worker that ends as it starts"
    _, alone = make_experience()
    begins = [gatherer.next()[0][:, 0] for gatherer in (experience, alone)]
    for key in (("agents", "observation", "map"), ("agents", "observation", "pose"), ("info", "coverage")):
        assert torch.equal(*(batch[key] for batch in begins)), "team i is team i, whoever simulates it"

    state = experience.state_dict()
    first = [batch.clone() for batch in experience.next()]
    second = [batch.clone() for batch in experience.next()]
    experience.load_state_dict(state)
    assert not differing(experience.next(), first)
    assert not differing(experience.next(), second)

    experience.load_state_dict(state)
    change(learner.policy)  # in the learner's memory alone
    assert not differing(experience.next(), first)
    experience.load_state_dict(state)  # hands over the weights too
    changed = experience.next()
    assert differing(changed, first)
    with torch.no_grad():
        again = learner.policy.get_dist_params(changed[0][:, 0].clone())
    torch.testing.assert_close(again["agents", "params"], changed[0][:, 0]["agents", "params"])

    victim = experience.groups[0].pids[1]
    os.kill(victim, signal.SIGKILL)
    begin = time.monotonic()
    with pytest.raises(WorkerLost, match=rf"collector worker 2 of 2 \(process {victim}\) was killed by SIGKILL"):
        experience.update_policy_weights_()
    experience.shutdown()
    while active_children():
        assert time.monotonic() - begin < 30, "a worker lives on"
        time.sleep(0.1)


@pytest.mark.slow
def test_one_batch_ahead_the_policy_is_one_batch_old(make_experience):
    learner, experience = make_experience("collector=two_devices", "num_robots=1,2")
    assert experience.lag == 1
    experience.next()
    state = experience.state_dict()
    change(learner.policy)
    experience.update_policy_weights_()
    old, new = ([batch.clone() for batch in experience.next()] for _ in range(2))
    assert [batch["agents", "params"].shape[2] for batch in new] == [1, 2]

    def acting(batches) -> list:
        with torch.no_grad():
            return [learner.policy.get_dist_params(batch.clone())["agents", "params"] for batch in batches]

    for batch, params in zip(new, acting(new), strict=True):
        torch.testing.assert_close(params["region"], batch["agents", "params", "region"])
    for batch, params in zip(old, acting(old), strict=True):
        assert not torch.allclose(params["region"]["logits"], batch["agents", "params", "region", "logits"], atol=1e-3)
    for _ in range(2):  # the second time workers are certainly busy with a batch
        experience.load_state_dict(state)
    assert not differing(experience.next(), old)


@pytest.mark.slow
def test_ray_workers_go_on_where_they_were_and_a_killed_one_is_named(make_experience):
    pytest.importorskip("ray", reason="RAY ABSENT: pip install -c constraints.txt 'maexp[ray]' to test collector=ray")
    learner, experience = make_experience("collector=ray")
    _, alone = make_experience()
    begins = [gatherer.next()[0][:, 0] for gatherer in (experience, alone)]
    assert torch.equal(*(batch["agents", "observation", "map"] for batch in begins))
    assert begins[0].shape == (4,)
    state = experience.state_dict()
    first = [batch.clone() for batch in experience.next()]
    experience.load_state_dict(state)
    assert not differing(experience.next(), first)
    change(learner.policy)
    experience.load_state_dict(state)
    assert differing(experience.next(), first)
    place = experience.groups[0].places[1]
    os.kill(int(re.search(r"process (\d+)", place)[1]), signal.SIGKILL)
    with pytest.raises(WorkerLost, match=f"collector worker 2 of 2 .{place}. was lost to Ray"):
        experience.next()
    experience.shutdown()


def test_a_worker_that_cannot_start_is_reported(make_experience, monkeypatch):
    monkeypatch.setattr("multiprocessing.spawn._python_exe", b"/bin/false")
    with pytest.raises(UserError, match="a collector worker ended while it started"):
        make_experience("collector=processes")


# Whole runs

PROGRAM = """
import sys
from maexp.agents.cli import train
train.draw_rollout = train.draw_curves = lambda *args: None
from maexp.agents.cli import main
if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
"""


@pytest.fixture
def program(tmp_path, monkeypatch) -> list[str]:
    """The command `maexp train` without its pictures; a file, for spawned workers import it."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)
    return [sys.executable, str(path)]


def finish(command: list[str], *words: str) -> subprocess.CompletedProcess:
    return subprocess.run([*command, *words], capture_output=True, text=True, timeout=600)


def descendants(pid: int) -> list[int]:
    """Processes below this one that run our code (not multiprocessing's own helper)."""
    found, waiting = [], [pid]
    while waiting:
        parent = waiting.pop()
        for task in Path(f"/proc/{parent}/task").glob("*/children"):
            children = [int(word) for word in task.read_text().split()]
            waiting += children
            found += [p for p in children if "spawn_main" in Path(f"/proc/{p}/cmdline").read_text()]
    return found


def wait_until(happened, process: subprocess.Popen, seconds: float = 300) -> None:
    limit = time.monotonic() + seconds
    while not happened():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < limit, "it took too long"
        time.sleep(0.02)


def rows(folder: str) -> int:
    path = Path(folder, "metrics.csv")
    return len(path.read_text().splitlines()) if path.is_file() else 0


@pytest.mark.slow
@pytest.mark.parametrize("collector", ["processes", "two_devices"])
def test_resumed_with_workers_is_uninterrupted(collector, program):
    choice = [*TINY, f"collector={collector}"]
    for folder, count in (("whole", 4), ("parts", 2)):
        done = finish(program, *choice, f"hydra.run.dir={folder}", f"total_frames={count * BATCH}")
        assert done.returncode == 0, done.stderr
    assert "worker" in done.stdout and ("older" in done.stdout) == (collector == "two_devices")
    done = finish(program, "resume=parts", f"total_frames={4 * BATCH}")
    assert done.returncode == 0 and "warning" not in done.stderr, done.stderr
    whole, parts = (find_checkpoint(folder)[1] for folder in ("whole", "parts"))
    assert whole["iteration"] == parts["iteration"] == 4
    for name in whole["policy"]:
        assert torch.equal(whole["policy"][name], parts["policy"][name]), name
    assert {row["policy_lag"] for row in read_metrics(Path("parts/metrics.csv"))} == {float(collector == "two_devices")}
    done = finish(program, "resume=parts", "collector=single", f"total_frames={5 * BATCH}")
    assert done.returncode == 0 and "new episodes begin" in done.stderr, done.stderr


@pytest.mark.slow
def test_a_killed_worker_ends_the_run_by_name_and_a_killed_run_ends_its_workers(program):
    command = [*program, *TINY, "collector=processes", "total_frames=1000000", "checkpoint_every=1"]
    process = subprocess.Popen([*command, "hydra.run.dir=run"], stderr=subprocess.PIPE, text=True)
    wait_until(lambda: rows("run") > 2, process)
    victim = min(descendants(process.pid))
    os.kill(victim, signal.SIGKILL)
    error = process.communicate(timeout=60)[1]
    assert process.returncode == 2, error
    assert re.search(rf"collector worker \d of 2 \(process {victim}\) was killed by SIGKILL", error), error
    assert "last good checkpoint is kept in" in error and "Traceback" not in error
    done = find_checkpoint("run")[1]["iteration"]
    assert done >= 1

    process = subprocess.Popen([*program, "resume=run"], stderr=subprocess.PIPE, text=True)
    wait_until(lambda: rows("run") > done + 2, process)
    workers = descendants(process.pid)
    assert len(workers) == 2
    process.kill()
    process.wait()
    limit = time.monotonic() + 60
    while any(Path(f"/proc/{pid}").exists() for pid in workers):
        assert time.monotonic() < limit, "workers of a killed run live on"
        time.sleep(0.1)
    assert find_checkpoint("run")[1]["iteration"] > done


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["collector.workers=2"], "collector.workers=2 needs collector=processes or collector=ray"),
        (["collector.overlap=true"], "collector.overlap=True needs collector=processes"),
        (["collector=processes", "collector.workers=3"], "num_envs=4 cannot be shared evenly by collector.workers=3"),
        (["collector=processes", "collector.workers=0"], "collector.workers=0 must be a whole number"),
        (["collector.backend=threads"], "collector.backend=threads is unknown: choose one of single, processes, ray"),
        (["collector.sample_device=abacus"], "collector.sample_device=abacus cannot be used here"),
        (["collector.train_device=abacus"], "collector.train_device=abacus cannot be used here"),
        (["collector.ray_address=auto"], "collector.ray_address=auto needs collector=ray"),
        (["logger.backends=[diary]"], "logger.backends=diary is unknown: choose of tensorboard, wandb"),
        (["logger.mode=dry"], "logger.mode=dry is unknown: choose one of online, offline"),
    ],
)
def test_settings_that_do_not_go_together(words, sentence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["train", *TINY, "total_frames=8", *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"maexp: {sentence}") and error.count("\n") == 1
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize("extra", ["ray", "tensorboard", "wandb"])
def test_an_extra_that_is_missing_is_named_with_its_command(extra, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, extra, None)
    choice = "collector=ray" if extra == "ray" else f"logger={extra}"
    assert main(["train", *TINY, "total_frames=8", choice]) == 2
    error = capsys.readouterr().err
    assert f"pip install 'maexp[{extra}]'" in error and error.count("\n") == 1, error
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


# Loggers


def test_tensorboard_and_wandb_hold_the_numbers_of_metrics_csv(tmp_path, monkeypatch):
    absent = [name for name in ("tensorboard", "wandb") if importlib.util.find_spec(name) is None]
    present = [name for name in ("tensorboard", "wandb") if name not in absent]
    if not present:
        pytest.skip("LOGGERS ABSENT: pip install -c constraints.txt 'maexp[tensorboard,wandb]' to test them")
    monkeypatch.chdir(tmp_path)
    for place in ("draw_rollout", "draw_curves"):
        monkeypatch.setattr(f"maexp.agents.cli.train.{place}", lambda *args: None)
    words = [f"logger.backends=[{','.join(present)}]", "logger.mode=offline", "evaluate_every=1", "evaluate_episodes=2"]
    assert main(["train", *TINY, *words, "hydra.run.dir=run", f"total_frames={2 * BATCH}"]) == 0
    assert main(["train", "resume=run", f"total_frames={3 * BATCH}"]) == 0
    written = read_metrics(Path("run/metrics.csv"))
    if "tensorboard" in present:
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        events = EventAccumulator("run/tensorboard").Reload()
        for name in written[0]:
            wanted = [(row["frames"], row[name]) for row in written if row[name] == row[name]]
            found = [(e.step, e.value) for e in events.Scalars(tag(name))] if wanted else []
            assert [step for step, _ in found] == [step for step, _ in wanted], name
            assert [value for _, value in found] == pytest.approx([value for _, value in wanted], rel=1e-5), name
    if "wandb" in present:
        runs = sorted(Path("run/wandb").glob("offline-run-*"))
        identity = Path("run/wandb/identity").read_text()
        assert len(runs) == 2 and all(run.name.endswith(identity) for run in runs), "resumed is the same run"
    if absent:
        pytest.skip(f"{absent[0].upper()} ABSENT: the rest passed; pip install -c constraints.txt 'maexp[{absent[0]}]'")
