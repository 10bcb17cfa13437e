"""The leaderboard: rows say what their runs say, and the page shows them in a browser without a network."""

import base64
import json
import re
import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest
from browser import find_browser, open_tab
from paths import ROOT

from maexp.agents.benchmarks import leaderboard
from maexp.agents.benchmarks.leaderboard import NOTHING, UNSEEN, WALL
from maexp.agents.benchmarks.suites.suite import load_suite
from maexp.agents.cli import main
from maexp.envs import make_map

pytestmark = pytest.mark.slow  # whole runs of suites

PLAYED = ("nearest_frontier", "random")


@pytest.fixture(scope="module")
def runs(small_suite, tmp_path_factory) -> list[Path]:
    """The folders of two runs of it: not to be changed."""
    where = tmp_path_factory.mktemp("runs")
    for name in PLAYED:
        assert main(["suite", "run", str(small_suite), f"policy={name}", f"hydra.run.dir={where / name}"]) == 0
    return [where / name for name in PLAYED]


@pytest.fixture(scope="module")
def board(small_suite, runs, tmp_path_factory) -> Path:
    """A leaderboard of them: not to be changed."""
    out = tmp_path_factory.mktemp("board") / "site"
    assert main(["leaderboard", *map(str, runs), f"out={out}", f"suite={small_suite}"]) == 0
    return out


def read_all(board: Path) -> list[dict]:
    return [leaderboard.read_row(path) for path in leaderboard.find_rows(board)]


def test_a_row_says_what_its_run_says(runs, board):
    assert sorted(path.name for path in (board / "small").iterdir()) == [f"{name}.json" for name in PLAYED]
    for run, name in zip(runs, PLAYED, strict=True):
        row = leaderboard.read_row(board / "small" / f"{name}.json")
        results = json.loads((run / "results.json").read_text())
        assert row["verified"] and row["policy"] == name and row["suite"] == results["suite"]
        assert row["score"]["mean"] == pytest.approx(results["score"]["mean"], abs=1e-6)
        assert row["reference"]["difference"]["ci95"] == pytest.approx(
            results["reference"]["difference"]["coverage_auc"]["ci95"], abs=1e-6
        )
        for part, figures in row["parts"].items():
            assert figures["episodes"] == pytest.approx(results["episodes"][part]["coverage_auc"], abs=1e-6)
            assert len(np.unique(figures["copies"])) == 4


def test_a_film_shows_the_first_episode(runs, board):
    row = leaderboard.read_row(board / "small" / "random.json")
    results = json.loads((runs[1] / "results.json").read_text())
    for part, film in row["films"].items():
        place = make_map(part, int(film["map"].rsplit("_", 1)[1]))
        assert film["map"] == results["episodes"][part]["map"][0]
        assert film["coverage"][-1] == round(1000 * results["episodes"][part]["exploration_ratio"][0])
        width, height = film["cells"]
        picture = np.frombuffer(zlib.decompress(base64.b64decode(film["picture"])), np.uint8).reshape(height, width)
        extent = np.diff(place.extent, axis=0)[0]
        assert width / height == pytest.approx(extent[0] / extent[1], abs=0.1)
        frames = len(film["seconds"])
        seen, free = picture < frames, picture < WALL
        assert ((picture >= UNSEEN) | seen).all() and (picture == WALL).any() and seen.any()
        assert seen.sum() / free.sum() == pytest.approx(film["coverage"][-1] / 1000, abs=0.06)
        tracks = np.array(film["tracks"]).reshape(frames, 3, 2)
        assert (picture[tuple(cell_of(tracks[-1], film["cells"]).T[::-1])] != NOTHING).all()
        assert (picture[tuple(cell_of(tracks[0], film["cells"]).T[::-1])] == 0).all(), "seen from the start"


def cell_of(points: np.ndarray, cells: list[int]) -> np.ndarray:
    """Column and row of points [per mille]."""
    return np.rint(points / 1000 * (max(cells) - 1)).astype(int)


def test_pairs_are_compared_with_copies_counted_once(board):
    suite = leaderboard.describe_suite(read_all(board))
    (none, better), (worse, also_none) = suite["better"]
    assert none is also_none is None and better["mean"] + worse["mean"] == pytest.approx(1)
    copied = read_all(board)
    for part in copied[0]["parts"].values():
        part["copies"] = [0] * len(part["copies"])
    assert np.isnan(leaderboard.describe_suite(copied)["better"][0][1]["ci95"]).all(), (
        "two distinct episodes are no evidence"
    )


def test_a_note_stands_on_the_page_and_in_the_tables(board, tmp_path, capsys):
    out, row = tmp_path / "site", board / "small" / "random.json"
    assert main(["leaderboard", str(board), f"out={out}"]) == 0
    assert main(["leaderboard", str(row), f"out={out}", "note=one | dice\n</script> a robot"]) == 0
    assert [row.get("note") for row in read_all(out)] == [None, "one | dice </script> a robot"]
    assert "- `random`: one \\| dice &lt;/script&gt; a robot\n" in (out / "README.md").read_text()
    assert "one | dice \\u003c/script>" in (out / "index.html").read_text()
    content = json.loads(row.read_text())
    (out / "small" / "random.json").write_text(json.dumps(content | {"note": 3}))
    assert main(["leaderboard", f"out={out}"]) == 2
    assert "note is of another kind" in capsys.readouterr().err


def test_who_is_replaced_is_told_and_another_policy_is_not(board, tmp_path, capsys):
    out, row = tmp_path / "site", json.loads((board / "small" / "random.json").read_text())
    assert main(["leaderboard", str(board), f"out={out}"]) == 0
    capsys.readouterr()
    assert main(["leaderboard", str(board), f"out={out}"]) == 0
    assert "is replaced" not in capsys.readouterr().out, "the same rows"
    for policy, status in (("random", 0), ("a/b", 0), ("a b", 2)):
        path = tmp_path / "row.json"
        path.write_text(json.dumps(row | {"policy": policy, "decisions": {}}))
        assert main(["leaderboard", str(path), f"out={out}"]) == status
        told = capsys.readouterr()
        assert ("random on small was there already, with score 0." in told.out) == (policy == "random")
    assert "a b would replace a/b" in told.err and len(read_all(out)) == 3


def test_rows_stay_and_join(small_suite, runs, board, tmp_path, capsys):
    out = tmp_path / "site"
    assert main(["leaderboard", str(runs[1]), f"out={out}", f"suite={small_suite}", "verify=false"]) == 0
    assert [row["verified"] for row in read_all(out)] == [False]
    assert main(["leaderboard", str(board / "small" / "nearest_frontier.json"), f"out={out}"]) == 0
    assert [row["policy"] for row in read_all(out)] == list(PLAYED)
    assert main(["leaderboard", str(board), f"out={out}"]) == 0
    assert [row["verified"] for row in read_all(out)] == [True, True], "a row of the same name is replaced"
    for name in (leaderboard.PAGE, leaderboard.TABLES):
        assert (out / name).read_text() == (board / name).read_text()
        (out / name).unlink()
    assert main(["leaderboard", f"out={out}"]) == 0
    assert (out / leaderboard.PAGE).is_file(), "the page again, from the rows that are there"
    assert "2 rows on 1 suite." in capsys.readouterr().out


def edit_score(run: Path) -> None:
    path = run / "results.json"
    results = json.loads(path.read_text())
    results["score"]["mean"] += 0.01
    path.write_text(json.dumps(results))


def edit_checksum(run: Path) -> None:
    path = run / "results.json"
    path.write_text(re.sub(r'("checksum": ")\w{4}', r"\1beef", path.read_text(), count=1))


def edit_maps(run: Path) -> None:
    path = run / "results.json"
    path.write_text(path.read_text().replace('"frozen_maps": true', '"frozen_maps": false'))


@pytest.mark.parametrize(
    ("edit", "words", "told"),
    [
        (edit_score, [], "is not what it says (results.json: score.mean)"),
        (edit_checksum, ["verify=false"], "was played with another version of small"),
        (edit_maps, ["verify=false"], "was played on other maps or starts (seed=0)"),
    ],
)
def test_a_run_that_is_not_what_it_says_is_no_row(edit, words, told, small_suite, runs, tmp_path, capsys):
    edit(Path(shutil.copytree(runs[1], tmp_path / "run")))
    assert main(["leaderboard", str(tmp_path / "run"), f"out={tmp_path / 'site'}", f"suite={small_suite}", *words]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda row: row.pop("films"), "row.films is missing"),
        (lambda row: row["score"].update(mean="0.9"), "row.score.mean is of another kind"),
        (lambda row: row["score"].update(mean=0.9), "its score does not follow from its episodes"),
        (lambda row: row["parts"]["maze_small"].pop("coverage_auc"), "a part has too few entries"),
        (lambda row: row["parts"]["maze_small"]["episodes"].append("x"), "row.parts.maze_small.episodes is of another"),
        (lambda row: row["films"].pop("maze_small"), "are not of the same parts"),
        (lambda row: row.update(format="maexp-leaderboard-row-0"), "format maexp-leaderboard-row-0"),
        (lambda row: row.update(verified=1), "row.verified is of another kind"),
        (lambda row: row.clear(), "row has no entries"),
    ],
)
def test_a_damaged_row_is_named(change, told, board, tmp_path, capsys):
    out = Path(shutil.copytree(board, tmp_path / "site"))
    path = out / "small" / "random.json"
    row = json.loads(path.read_text())
    change(row)
    path.write_text(json.dumps(row))
    assert main(["leaderboard", f"out={out}"]) == 2
    error = capsys.readouterr().err
    assert "random.json is damaged or no row of a leaderboard" in error and told in error


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "out is missing"),
        (["nowhere", "out=site"], "nowhere is no finished run of maexp suite"),
        (["out=site"], "No row is in out=site yet"),
        (["out=full"], "holds something else than a leaderboard"),
        (["out=full/note.txt"], "is a file: name a folder"),
        (["verify=maybe", "out=site"], "verify"),
    ],
)
def test_bad_words_get_a_sentence(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note.txt").write_text("mine")
    assert main(["leaderboard", *words]) == 2
    error = capsys.readouterr().err
    assert told in error and "Traceback" not in error
    assert not (tmp_path / "site").exists()


def test_names_of_policies_make_no_paths():
    suite = {"name": "small", "version": 2}
    assert leaderboard.file_of({"suite": suite, "policy": "../../etc/passwd"}) == "small-v2/_.._etc_passwd.json"
    assert leaderboard.file_of({"suite": suite, "policy": "exec:./a b"}) == "small-v2/exec_._a_b.json"


def test_the_rows_of_this_project_are_of_its_suites_and_in_its_tables(tmp_path):
    board = ROOT / "docs" / "leaderboard"
    kept = read_all(board)
    for row in kept:
        assert row["verified"] and row["suite"]["checksum"] == load_suite(row["suite"]["name"]).checksum
    assert len(leaderboard.group(kept)) >= 4 and len({row["policy"] for row in kept}) >= 9
    leaderboard.write_site(tmp_path, kept)
    assert (tmp_path / leaderboard.TABLES).read_text() == (board / leaderboard.TABLES).read_text()


HOSTILE = "</script><img src=x onerror=document.title=1>"


@pytest.fixture(scope="module")
def tab(board, tmp_path_factory):
    """The page in Chromium: two rows, and one more of a name that would like to be code, without intervals."""
    program = find_browser()
    if program is None:
        pytest.skip("NO CHROMIUM: the page of the leaderboard is not looked at")
    out = Path(shutil.copytree(board, tmp_path_factory.mktemp("look") / "site"))
    row = json.loads((out / "small" / "random.json").read_text())
    row["policy"] = HOSTILE
    for figure in (row["score"], row["reference"]["difference"], row["reference"]["improvement"]):
        figure["ci95"] = [None, None]
    leaderboard.write_row(out, row)
    leaderboard.write_site(out, read_all(out))
    with open_tab(program, f"file://{out / leaderboard.PAGE}", tmp_path_factory.mktemp("profile")) as tab:
        tab.wait_for("seen after")
        yield tab


def column(tab, number: int) -> list[str]:
    return tab.run(f"[...document.querySelectorAll('#table tbody tr')].map(x => x.cells[{number}].innerText)")


@pytest.mark.parametrize(("width", "mobile"), [(1280, False), (390, True)])
def test_the_page_fits_desk_and_phone(tab, width, mobile, tmp_path):
    tab.call("Emulation.setDeviceMetricsOverride", width=width, height=800, deviceScaleFactor=1, mobile=mobile)
    assert tab.run("document.documentElement.scrollWidth") <= width
    inside = "x => x.getBoundingClientRect().right < innerWidth"
    assert tab.run(f"[...document.querySelectorAll('svg text')].every({inside})")
    assert tab.picture(tmp_path / "page.png").stat().st_size > 10_000


def test_the_page_is_sorted_by_any_column(tab):
    assert column(tab, 0)[0] == "nearest_frontier", "by score at first"
    press = "document.querySelector('#table th button').click()"
    tab.run(press)
    assert column(tab, 0) == [HOSTILE, "nearest_frontier", "random"]
    tab.run(press)
    assert column(tab, 0) == ["random", "nearest_frontier", HOSTILE]


def test_the_page_needs_no_network_and_runs_no_names(tab, board):
    assert tab.run("document.title") == "MAexp leaderboard"
    assert tab.run("performance.getEntriesByType('resource').length") == 0
    addresses = set(re.findall(r"https?://[^\"' ]*", (board / leaderboard.PAGE).read_text()))
    assert addresses == {"http://www.w3.org/2000/svg"}, "the name of a format, which is not loaded"


def test_what_has_no_interval_has_a_dash(tab):
    assert column(tab, 2)[column(tab, 0).index(HOSTILE)] == "–"
    assert "NaN" not in tab.text() and "undefined" not in tab.text() and "null" not in tab.text()


def test_two_films_run_together(tab):
    told = "[...document.querySelectorAll('.told')].map(x => x.innerText)"
    end = tab.run(told)
    tab.run("document.getElementById('time').value = 0, document.getElementById('time').oninput()")
    start = tab.run(told)
    assert all(text.endswith("after 0 s") for text in start) and start != end
    tab.press("Play")
    assert tab.run("document.getElementById('play').innerText") == "Pause"
    tab.wait_for(end[0])
    tab.wait_for("Play")
    assert tab.run(told) == end
    painted = "[...document.getElementById('right_view').getContext('2d').getImageData(280, 280, 1, 1).data].join()"
    assert tab.run(painted) != "0,0,0,0"
