"""What settings mean, with their units, for those who read the config.yaml of a run."""

import re

LINE = re.compile(r"( *)(\w+):( \S.*)?")
SPANNING = ("[", "{", "'", '"', "|", ">")  # what may go on in the next line


def with_comments(text: str, comments: dict[str, str]) -> str:
    """The YAML of settings with a comment behind every value that has one under its full name."""
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
