"""Policies that ship: listed, shown, found by name everywhere, and refused in a sentence where they are damaged."""

import shutil

import pytest

from maexp.agents.cli import main
from maexp.agents.runtime.shipped import SHIPPED, shipped_names


def test_the_list_names_one_a_line(capsys):
    assert main(["policies", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == shipped_names() and len(lines) >= 2
    assert sum(file.stat().st_size for file in SHIPPED.rglob("*")) < 4e6


def test_one_is_shown(capsys):
    assert main(["policies", "show", "universal"]) == 0
    told = capsys.readouterr().out
    assert told.startswith("# universal") and f"Folder: {SHIPPED / 'universal'}" in told and "## Training" in told


@pytest.mark.parametrize("words", [
    ["policies", "show", "universl"], ["evaluate", "policy=universl"], ["view", "policy=universl"],
    ["irsim", "floor.yaml", "policy=universl"], ["train", "warm_start=universl"],
])  # fmt: skip
def test_a_name_that_is_none_is_a_sentence_with_the_near_ones(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    told = capsys.readouterr().err
    assert "universl is " in told and "did you mean universal" in told and told.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("file", "change", "part"), [
    ("weights.safetensors", lambda data: data[:-1] + b"x", "is not the file that its contract names"),
    ("weights.safetensors", None, "No such file"),
    ("policy.onnx", lambda data: data[:100], "is not the file that its contract names"),
    ("contract.json", lambda data: data.replace(b"maexp-policy-2", b"maexp-policy-9"), "of the kind maexp-policy-2"),
])  # fmt: skip
@pytest.mark.parametrize("words", [["evaluate", "policy=mine"], ["view", "policy=mine"], ["train", "warm_start=mine"]])
def test_a_damaged_folder_is_a_sentence(file, change, part, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(SHIPPED / "universal", "mine")
    data = (tmp_path / "mine" / file).read_bytes()
    (tmp_path / "mine" / file).unlink()
    if change is not None:
        (tmp_path / "mine" / file).write_bytes(change(data))
    assert main(words) == 2
    told = capsys.readouterr().err
    assert part in told and told.count("\n") == 1


def test_a_foreign_folder_and_two_of_one_name_are_sentences(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    shutil.copytree(SHIPPED / "universal", "mine/universal")
    for policy, part in (
        ("empty", "empty is not the folder of a policy: No such file"),
        ("file", "policy=file is a file: give the folder that maexp export wrote"),
        ("universal,mine/universal", "names universal twice"),
    ):
        assert main(["evaluate", f"policy={policy}"]) == 2
        told = capsys.readouterr().err
        assert part in told and told.count("\n") == 1
