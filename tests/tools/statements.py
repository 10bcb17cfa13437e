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
        id(one.body[0]) for one in nodes if isinstance(one, DOCUMENTED) and ast.get_docstring(one) is not None
    }
    for one in [node for node in nodes if isinstance(node, ast.stmt) and id(node) not in docstrings]:
        fields = [(name, part) for name, part in ast.iter_fields(one) if name not in BODIES]
        yield ast.dump(type(one)(**dict(fields)))


def read(commit: str) -> dict[str, Counter[str]]:
    """File -> its statements."""
    paths = [one for one in git("ls-tree", "-r", "--name-only", commit, *FOLDERS).splitlines() if one.endswith(".py")]
    return {path: Counter(statements(git("show", f"{commit}:{path}"))) for path in paths}


def folder(path: str) -> str:
    return "/".join(path.split("/")[:-1][:2])


def total(files: dict[str, Counter[str]]) -> int:
    return sum(one.total() for one in files.values())


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
    known = {path: one for path, one in after.items() if path in was}
    print(
        f"in {len(known)} files that stood there: {sum(before[was[path]].total() for path in known):,}", end=" before, "
    )
    gone = {path: one for path, one in before.items() if path not in was.values()}
    fresh = {path: one for path, one in after.items() if path not in was}
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
