"""From the words of a command line to Hydra overrides: paths and lists are quoted, so that any file name works."""

import os
import re
from functools import lru_cache
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, OverrideParseException

from maexp.agents.config.schema import default_values
from maexp.agents.config.verbs import SCHEMAS
from maexp.agents.errors import UserError
from maexp.envs.config import STARTS

PATHS = (
    "scenario.path",
    "scenario.starts",
    "checkpoint",
    "resume",
    "file",
    "place",
    "out",
    "baseline",
    "results",
    "suite",
    "hydra.run.dir",
    "hydra.sweep.dir",
)
WORDS = (("suite", "policy"), ("ros2", "policy"))
"""Commands of other programs, taken as they stand."""
POLICIES = {"evaluate": ("policy",), "benchmark": ("policies",), "train": ("classical",)}
"""Settings that name several policies, by the verb: names, folders, module:function."""
ALSO = {"scenario": "scenarios", "algorithm": "algorithms", "policy": "policies", "seed": "seeds"}
"""Names that the other verbs have for one value of a list of `maexp benchmark`."""
LISTS = {
    "train": ("num_robots", "classical"),
    "export": ("num_robots",),
    "evaluate": ("num_robots", "policy"),
    "bench": ("num_robots", "axes"),
    "ros2": ("robots", "map_topics", "offsets", "robot_radius"),
    "benchmark": ("scenarios", "algorithms", "policies", "seeds", "maps"),
}


@lru_cache(maxsize=4096)
def parse(word: str) -> Override:
    """An override as Hydra reads it; HydraException, OverrideParseException or ValueError where it is none."""
    return OverridesParser.create().parse_override(word)


def split_flags(words: list[str]) -> tuple[list[str], list[str]]:
    """(flags that start with a dash, with the value of --cfg and the like, and the rest)."""
    flags, rest, left = [], [], iter(words)
    for word in left:
        if not word.startswith("-") or "=" in word.split("-")[0]:
            rest.append(word)
            continue
        flags.append(word)
        if word in ("--cfg", "-c", "--package", "-p"):
            flags.append(next(left, ""))
    return flags, rest


def make_overrides(verb: str, words: list[str], positional: tuple[str, ...] = (), multirun: bool = False) -> list[str]:
    """Hydra overrides of the words after a verb.

    Args:
        verb: decides which settings take a list (num_robots=1,2,6)
        words: name=value, or bare values for the settings in `positional`, in order
        positional: settings that may be given without their name; one that ends in ... takes all that is left
        multirun: commas mean a sweep, so they are left alone

    Raises:
        UserError: a bare word too many, one that is no override even when quoted, or policies given twice.
    """
    names = list(positional)
    known = {*default_values(SCHEMAS[verb]), "hydra"}
    result, several = [], []
    for word in words:
        name, sign, value = word.partition("=")
        setting = sign and re.fullmatch(r"[+~]*[\w./@:-]+", name)
        if not setting or (names and re.split(r"[./]", name.lstrip("+~"))[0] not in known):
            if not names:
                raise UserError(f"{word!r} is no setting of maexp {verb}: write name=value (see maexp {verb} --help).")
            if names[0].endswith("..."):
                several.append(quote(word))
                continue
            name, value = names.pop(0), word
        if verb == "benchmark":
            name = ALSO.get(name, name)
        result.append(_make_override(verb, name, value, multirun))
    if several:
        result.append(f"{names[0].removesuffix('...')}=[{','.join(several)}]")
    _check_once(verb, result)
    return result


def _check_once(verb: str, overrides: list[str]) -> None:
    """Raise UserError for `policy=a policy=b`, as if both played: of other settings the last counts."""
    words = [word for word in overrides if verb == "evaluate" and word.startswith("policy=")]
    if len(words) > 1:
        values = ",".join(word.partition("=")[2].strip("[]") for word in words)
        raise UserError(f"policy is given twice, {words[0]} and {words[1]}: write policy={values} to play them all.")


def _make_override(verb: str, name: str, value: str, multirun: bool) -> str:
    if (name in PATHS or (verb, name) in WORDS) and value not in ("", "null") and not _is_quoted(value):
        if multirun and "," in value and not Path(value).exists():
            return f"{name}={value}"
        if name == "scenario.starts" and value not in STARTS:  # kept with the run, as the next
            value = str(Path(value).expanduser().absolute())
        if name == "scenario.path":  # kept with the run, which may be resumed from another folder
            value = ",".join(str(Path(path).expanduser().absolute()) for path in split_paths(value))
        return f"{name}={quote(value)}"
    if not multirun and name in POLICIES.get(verb, ()) and not OPERATOR.match(value):
        return f"{name}={quote_policies(value, verb == 'benchmark')}"
    if not multirun and name in LISTS.get(verb, ()) and "," in value and not value.startswith("["):
        return f"{name}=[{value}]"
    for word in (f"{name}={value}", f"{name}={quote(value)}"):
        try:
            parse(word)
            return word
        except (OverrideParseException, HydraException):
            continue
        except ValueError as error:  # a whole number of thousands of digits
            raise UserError(f"{name}={value[:20]}... cannot be read as a number: give fewer digits.") from error
    raise UserError(f"{name}={value} cannot be read as a setting: write name=value (see maexp {verb} --help).")


OPERATOR = re.compile(r"\[?\s*['\"$]|(null|\[\s*\])?$")
"""Values that Hydra reads by itself: quoted ones, references, nothing."""


def quote_policies(value: str, absolute: bool) -> str:
    """One policy or several, `a,b` or `[a,b]`, each quoted, so that any folder's name works.

    Args:
        absolute: write folders as such from the root: they are kept, and gone on with from elsewhere.
    """
    single = os.path.exists(value)
    listed = not single and ("," in value or value.startswith("["))
    words = value.removeprefix("[").removesuffix("]").split(",") if listed else [value]
    words = [word.strip() for word in words]
    if absolute:  # a name of ours is one even where a folder is called the same
        words = [from_root(word) for word in words]
    quoted = [quote(word) if not re.fullmatch(r"[A-Za-z_][\w.]*", word) else word for word in words]
    return f"[{','.join(quoted)}]" if listed else quoted[0]


def from_root(word: str) -> str:
    """The word for a policy, a folder as such from the root."""
    return str(Path(word).absolute()) if os.sep in word and os.path.exists(word) else word


def split_paths(text: str) -> list[str]:
    """The files that `text` names: one, or several as a.yaml,b.pcd or [a.yaml,b.pcd].

    A comma separates nothing in the name of a file that is there, nor where what it parts has no ending.
    """
    if text.startswith("[") and text.endswith("]"):
        text = text[1:-1]
    parts = [part.strip() for part in text.split(",") if part.strip()]
    single = Path(text).expanduser().exists() or not all(Path(part).suffix for part in parts)
    return [text] if single else parts


def quote(text: str) -> str:
    """`text` as a Hydra string that is neither parsed nor interpolated."""
    escaped = re.sub(r"(\\*)'", lambda found: found[1] * 2 + r"\'", text)
    escaped = re.sub(r"(\\+)$", lambda found: found[1] * 2, escaped)
    return "'" + escaped.replace("${", r"\${") + "'"


def _is_quoted(text: str) -> bool:
    return len(text) >= 2 and text[0] == text[-1] and text[0] in "'\""


def find_override(overrides: list[str], name: str) -> str | None:
    """The value that the last override of `name` gives, unquoted; None if there is none."""
    parsed = [override for override in map(parse, overrides) if override.key_or_group == name]
    values = [override.value() for override in parsed if not override.is_delete()]
    return None if not values or values[-1] is None else str(values[-1])


def set_names(overrides: list[str]) -> list[str]:
    """Full names of the settings and groups that the words set."""
    return [parse(word).key_or_group for word in overrides]


def without(overrides: list[str], *names: str) -> list[str]:
    """`overrides` less those of the settings or groups called `names`; UserError where they are none (from a file)."""
    try:
        keys = set_names(overrides)
    except (HydraException, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"The checkpoint holds settings that cannot be read ({reason}): give another one.") from error
    return [
        word
        for word, key in zip(overrides, keys, strict=True)
        if key not in names and key.partition(".")[0] not in names
    ]


# Several values of a setting


def find_sweeps(overrides: list[str]) -> dict[str, list[str]]:
    """The settings given several values (num_envs=8,64), each with its overrides, one per value."""
    several = [override for override in map(parse, overrides) if override.is_sweep_override()]
    return {
        override.key_or_group: [f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator()]
        for override in several
    }


def move_sweeps(overrides: list[str], single: tuple[str, ...] = ()) -> list[str]:
    """`overrides` with the first of several values each, and `sweep=[...]`, which holds them all.

    Raises:
        UserError: a setting in `single` was given several values.
    """
    several = [word for word in overrides if parse(word).is_sweep_override()]
    swept = find_sweeps(several)
    for name in swept:
        if name.split(".")[0] in single:
            raise UserError(f"{name} takes one value here, not several.")
    firsts = [swept[parse(word).key_or_group][0] if word in several else word for word in overrides]
    return [*firsts, f"sweep=[{','.join(quote(word) for word in several)}]"] if several else firsts
