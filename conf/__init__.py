"""The choices of settings, a YAML for each with only what it changes, and one primary config for each verb.

Hydra composes these files. `read_choice` reads a choice without Hydra, for the tables of the code: `SCENARIOS`,
`TUNINGS`, `SIZES`. The first line of a file that is no `# @package` says what the choice is, as `--help` prints it.
"""

from functools import cache
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent


@cache
def groups() -> tuple[str, ...]:
    """Names of the groups of settings that offer choices."""
    return tuple(sorted(path.name for path in FOLDER.iterdir() if path.is_dir() and path.name[0] not in "_."))


@cache
def list_choices(group: str) -> dict[str, str]:
    """The choices of a group, each with its line of help: {"maze": "125 m mazes ..."}."""
    texts = {path.stem: path.read_text().splitlines() for path in sorted((FOLDER / group).glob("*.yaml"))}
    first = {name: next(line for line in lines if not line.startswith("# @")) for name, lines in texts.items()}
    return {name: line.removeprefix("#").strip() for name, line in first.items()}


@cache
def read_file(group: str, name: str) -> dict[str, Any]:
    """The content of a choice's file, its defaults list included."""
    import yaml  # robots that only plan have none

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return yaml.load((FOLDER / group / f"{name}.yaml").read_text(), loader) or {}


def read_choice(group: str, name: str) -> dict[str, Any]:
    """The settings of its group that a choice changes, those of the choice that it starts from among them."""
    content = read_file(group, name)
    values: dict[str, Any] = {}
    for entry in content.get("defaults", ()):
        if isinstance(entry, str) and entry != "_self_":
            values = merge(values, read_choice(group, entry))
    own = content.get(group, content)  # a choice that changes other groups too names its own
    return merge(values, {key: value for key, value in own.items() if key != "defaults"})


def merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Two mappings as one, and so those that both hold; the second wins."""
    both = {key: below[key] | above[key] for key in above if isinstance(below.get(key), dict)}
    return below | above | both


def groups_of_choice(group: str, name: str) -> list[str]:
    """The other groups and settings that a choice changes: those of a scenario that stands for a protocol."""
    content = read_file(group, name)
    if group not in content:
        return []
    chosen = [key for entry in content.get("defaults", ()) if isinstance(entry, dict) for key in entry]
    return [key.removeprefix("override /") for key in chosen] + [
        key for key in content if key not in (group, "defaults")
    ]
