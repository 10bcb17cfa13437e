"""Statements of the package by `ast`, without docstrings: `python tests/tools/statements.py COMMIT [COMMIT]`.

Of one commit: how many in each folder. Of two: what became of those of the first. A statement stands still where the
second has the same one somewhere, the bodies of compound ones apart; a file is the same one where git sees its name or
a rename.
"""

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator

FOLDERS = ("kernels", "envs", "agents")
BODIES = {"body", "orelse", "finalbody", "handlers", "cases"}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def git(*words: str) -> str:
    return subprocess.run(["git", *words], check=True, capture_output=True, text=True).stdout


def statements(source: str) -> Iterator[str]:
    """Every statement, without what stands in its bodies."""
    nodes = list(ast.walk(ast.parse(source)))
    docstrings = {
        id(node.body[0]) for node in nodes if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None
    }
    for node in [node for node in nodes if isinstance(node, ast.stmt) and id(node) not in docstrings]:
        fields = [(name, part) for name, part in ast.iter_fields(node) if name not in BODIES]
        yield ast.dump(type(node)(**dict(fields)))


def read(commit: str) -> dict[str, Counter[str]]:
    """File -> its statements."""
    paths = [
        path for path in git("ls-tree", "-r", "--name-only", commit, *FOLDERS).splitlines() if path.endswith(".py")
    ]
    return {path: Counter(statements(git("show", f"{commit}:{path}"))) for path in paths}


def folder(path: str) -> str:
    return "/".join(path.split("/")[:-1][:2])


def total(files: dict[str, Counter[str]]) -> int:
    return sum(file.total() for file in files.values())


def show(files: dict[str, Counter[str]]) -> None:
    sums: Counter[str] = Counter()
    for path, found in files.items():
        sums[folder(path)] += found.total()
    for name, count in sorted(sums.items()):
        print(f"| {name} | {count:,} |")


def compare(first: str, second: str) -> None:
    before, after = read(first), read(second)
    renamed = git("diff", "-M40%", "--diff-filter=R", "--name-status", first, second, "--", *FOLDERS)
    was = {path: path for path in after if path in before}
    was |= {new: old for _, old, new in (line.split("\t") for line in renamed.splitlines()) if new in after}
    old, new = sum(before.values(), Counter()), sum(after.values(), Counter())
    kept = (old & new).total()
    print(f"{first}: {old.total():,}; {second}: {new.total():,}")
    print(f"stand still {kept:,}, gone or rewritten {old.total() - kept:,}, new or rewritten {new.total() - kept:,}")
    known = {path: count for path, count in after.items() if path in was}
    print(
        f"in {len(known)} files that stood there: {sum(before[was[path]].total() for path in known):,}", end=" before, "
    )
    gone = {path: count for path, count in before.items() if path not in was.values()}
    fresh = {path: count for path, count in after.items() if path not in was}
    moved = (sum(fresh.values(), Counter()) & old).total()
    print(f"{total(known):,} now; in {len(gone)} files that went: {total(gone):,}")
    print(f"in {len(fresh)} files that came: {total(fresh):,}, of which {moved:,} stood somewhere before:")
    show(fresh)


if __name__ == "__main__":
    if len(sys.argv) == 3:
        compare(*sys.argv[1:])
    else:
        files = read(sys.argv[1] if sys.argv[1:] else "HEAD")
        show(files)
        print(f"| all | {total(files):,} |")
