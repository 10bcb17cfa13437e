"""What settings mean, with their units, for those who read the config.yaml of a run: the comments of `conf/`."""

import re
from importlib import resources

VALUE = re.compile(r"^(\w+): \S.*?  # (.+)$", re.MULTILINE)
LINE = re.compile(r"( *)(\w+):( \S.*)?")
SPANNING = ("[", "{", "'", '"', "|", ">")  # what may go on in the next line


def with_comments(text: str, settings: dict, helps: dict[str, str]) -> str:
    """The YAML of `settings` with a comment behind every value that `conf/` or `--help` explains.

    Args:
        helps: name -> line of help of the settings without a group
    """
    comments = helps | {name: one for group in settings for name, one in group_comments(group, settings[group]).items()}
    lines, path = text.splitlines(), []
    for k, line in enumerate(lines):
        found = LINE.fullmatch(line)
        if not found:
            continue
        indent, value = len(found[1]), (found[3] or "").strip()
        path = [*path[: indent // 2], found[2]]
        goes_on = k + 1 < len(lines) and len(lines[k + 1]) - len(lines[k + 1].lstrip()) > indent
        comment = comments.get(".".join(path))
        if value and comment and not goes_on and not value.startswith(SPANNING):
            lines[k] = f"{line}  # {comment}"
    return "\n".join(lines) + "\n"


def group_comments(group: str, values: object) -> dict[str, str]:
    """{"radar.range": "[m]"} of the files of a group of `conf/`; the one that was chosen explains first."""
    folder = resources.files("maexp.conf").joinpath(group)
    if not isinstance(values, dict) or not folder.is_dir():
        return {}
    chosen = f"{values.get('name') or values.get('kind')}.yaml"
    files = sorted((one for one in folder.iterdir() if one.name.endswith(".yaml")), key=lambda one: one.name)
    files.sort(key=lambda one: one.name != chosen)
    found: dict[str, str] = {}
    for file in files:
        for name, comment in VALUE.findall(file.read_text()):
            found.setdefault(f"{group}.{name}", comment)
    return found
