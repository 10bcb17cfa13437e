"""`maexp policies`: the trained policies that come with the package."""

from collections.abc import Callable
from pathlib import Path

from maexp.agents.cli import Command
from maexp.agents.config.verbs import PoliciesSettings
from maexp.agents.deploy.planner.bundle import CARD, SHIPPED, find_policy, read_contract, shipped_names
from maexp.agents.errors import UserError, blame_input


def folder(overrides: list[str], claim: Callable[[], Path]) -> None:
    """Nothing is written."""


def check(cfg: PoliciesSettings) -> None:
    """Raise UserError for a name too much or too few."""
    if cfg.task == "list" and cfg.name:
        raise UserError(f"maexp policies list lists all and takes no name: leave {cfg.name} out.")
    if cfg.task == "show" and not cfg.name:
        raise UserError(f"maexp policies show needs a name after it: {', '.join(shipped_names())}.")


def run(cfg: PoliciesSettings, where: None, overrides: list[str]) -> int:
    """Print one line a policy, or the card of one and where it lies."""
    with blame_input():
        if cfg.task == "list":
            for name in shipped_names():
                print(describe(name))
            return 0
        place = find_policy(cfg.name)
        read_contract(place)
        show((place / CARD).read_text())
        print(f"Folder: {place}")
    return 0


def show(card: str) -> None:
    """A card on the terminal, its tables as such; where it goes to a file or another program, as it is written."""
    from rich.console import Console
    from rich.markdown import Markdown

    if Console().is_terminal:
        Console().print(Markdown(card))
    else:
        print(card)


def describe(name: str) -> str:
    """A line about a policy that ships."""
    place = SHIPPED / name
    contract = read_contract(place)
    trained = contract.content["trained"]
    size = sum(file.stat().st_size for file in place.iterdir()) / 1024
    teams = ", ".join(map(str, trained["num_robots"]))
    return f"{name:<14}{trained['algorithm']} on {', '.join(trained['scenarios'])}; teams of {teams}; {size:.0f} kB"


COMMAND = Command(run, check, folder=folder)
