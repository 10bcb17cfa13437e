"""Hydra's composition with errors that people can read: which setting, which value, what to write instead."""

import difflib
import re
from dataclasses import is_dataclass
from importlib import resources

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from maexp.agents.errors import UserError
from maexp.agents.settings.checks import check_seed
from maexp.agents.settings.runs import Recipe

SWEEPING = ("train",)
"""Verbs that run values of a setting one after another, with -m."""
KINDS = {"Integer": "a whole number", "Float": "a number", "Boolean": "true or false", "String": "text"}


def group_choices(group: str) -> dict[str, str]:
    """The choices of a group with what they are: rows of the code's tables, and files of `conf/` with the comment on
    their first line. {"maze": "125 m mazes ..."}."""
    from maexp.agents.settings.schema import stored_choices

    found = {name: summary for name, (summary, _) in stored_choices().get(group, {}).items()}
    folder = resources.files("maexp.conf").joinpath(group)
    files = [path for path in folder.iterdir() if path.name.endswith(".yaml")] if folder.is_dir() else []
    return dict(sorted((found | {file.name[:-5]: _first_comment(file.read_text()) for file in files}).items()))


def _first_comment(text: str) -> str:
    """The first line without its #; Hydra wants "# @package" before it where there is one."""
    line = next(line for line in text.splitlines() if not line.startswith("# @"))
    return line.removeprefix("#").strip()


def groups() -> list[str]:
    """Names of the groups of settings that offer choices."""
    from maexp.agents.settings.schema import stored_choices

    folder = resources.files("maexp.conf")
    return sorted(
        {*stored_choices(), *(path.name for path in folder.iterdir() if path.is_dir() and path.name[0] != "_")}
    )


def compose_recipe(verb: str, recipe: Recipe) -> DictConfig:
    """The composed settings of a verb, with the values of a run in their places.

    Raises:
        UserError: the same as of `compose_config`; a value of the run that this version does not know.
    """
    cfg = compose_config(verb, [*recipe.defaults, *recipe.words])
    for name, value in recipe.values.items():
        try:
            OmegaConf.update(cfg, name, value)
        except OmegaConfBaseException as error:
            raise UserError(
                f"{recipe.source} holds {name}={value}, which this version of MAexp does not know: "
                "use the version that wrote it, as its config.yaml names it."
            ) from error
    return cfg


WITHOUT_BRANCHES = {"action=regions", "tuning=reference", "preset=paper"}
"""What expert iteration, the default algorithm of these verbs, does not go with."""
LEARNED = ("train", "evaluate", "export", "view")


def _default_algorithm(verb: str, overrides: list[str]) -> list[str]:
    """Words for another algorithm than the default where that does not fit; a word of the user's still decides."""
    chosen = any(word.startswith("algorithm=") for word in overrides)
    return ["algorithm=mappo"] if verb in LEARNED and not chosen and WITHOUT_BRANCHES & {*overrides} else []


def compose_config(verb: str, overrides: list[str], whole: bool = True) -> DictConfig:
    """The composed settings of a verb, with Hydra's own under `hydra`.

    Args:
        whole: a setting that is left open is an error.

    Raises:
        UserError: an override that does not fit, or a seed that is none.
    """
    from maexp.agents.settings.schema import register_schema, schema

    register_schema(verb)
    GlobalHydra.instance().clear()
    try:
        with initialize_config_module("maexp.conf", version_base="1.3"):
            cfg = compose(verb, [*_default_algorithm(verb, overrides), *overrides], return_hydra_config=True)
            missing = sorted(OmegaConf.missing_keys(OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])))
            if unknown := _find_unknown(cfg, schema(verb)):
                raise UserError(_name_unknown(unknown, verb))
    except (HydraException, OmegaConfBaseException, OverflowError, ValueError) as error:
        raise UserError(explain(error, verb)) from error
    if missing and whole:
        raise UserError(f"{missing[0]} is not set: add {missing[0]}=VALUE.")
    if cfg.get("seed") is not None:
        check_seed(cfg.seed)
    return cfg


def explain(error: Exception, verb: str) -> str:
    """One sentence for an error of Hydra or OmegaConf."""
    text = f"{error}\n{error.__cause__ or ''}"
    if found := re.search(r"Could not find '([^/']+)/([^']+)'", text):
        group, choice = found.groups()
        return f"{group}={choice} is unknown: choose one of {', '.join(group_choices(group))}."
    if found := re.search(r"Could not override '([^']+)'", text):
        return _name_unknown(found[1], verb)
    if found := re.search(r"Value '(.*?)' of type '\w+' could not be converted to (\w+)\s+full_key: (\S+)", text, re.S):
        value, kind, key = found.groups()
        return f"{key}={value} must be {KINDS.get(kind, kind)}."
    if found := re.search(r"cannot be assigned None|is not Optional.*?full_key: (\S+)", text, re.S):
        key = re.search(r"full_key: (\S+)", text)
        return f"{key[1] if key else 'a setting'}=null has no meaning: give it a value."
    if found := re.search(r"Ambiguous value for argument '([^']+)'", text):
        name, _, values = found[1].partition("=")
        sweep = "add -m to run one after another, " * (verb in SWEEPING)
        brackets = f"or, if it takes several, {name}=[{values}]"
        return f"{found[1]} gives several values: {sweep}write one value, {brackets}."
    if isinstance(error, OverflowError) and (found := re.search(r"full_key: (\S+)", text)):
        return f"{found[1]} has more than 308 digits, which no number of the machine holds: give fewer."
    lines = [line.strip() for line in text.splitlines() if line.strip() and "hydra.cc/docs" not in line]
    return " ".join(dict.fromkeys(lines[:3])) + f" (see maexp {verb} --help)."


def _name_unknown(name: str, verb: str) -> str:
    return f"{name} is not a setting of maexp {verb}{_suggest(name, verb)}."


def _find_unknown(node: DictConfig, kind: type, prefix: str = "") -> str | None:
    """The first setting that `kind` does not declare, as +comm.bogus=5 adds it; Hydra's own are left out."""
    for key in node:
        if key not in kind.__dataclass_fields__:
            if prefix + key != "hydra":
                return prefix + key
            continue
        child = node._get_node(key)
        if isinstance(child, DictConfig) and is_dataclass(of := OmegaConf.get_type(child)):
            if found := _find_unknown(child, of, f"{prefix}{key}."):
                return found
    return None


def _suggest(name: str, verb: str) -> str:
    """The settings that hold the name as a word, or a close one among the verb's, or the settings beside it."""
    from maexp.agents.settings.schema import schema

    names = _flat_names(OmegaConf.structured(schema(verb)))
    holding = [candidate for candidate in names if name in re.split(r"[._]", candidate)]
    nearest = [candidate for candidate in holding if candidate.count(".") == min(other.count(".") for other in holding)]
    if meant := nearest or difflib.get_close_matches(name, names, 1, 0.7):
        return f": did you mean {' or '.join(meant[:3])}"
    parent = name.rpartition(".")[0]
    beside = [candidate for candidate in names if candidate.rpartition(".")[0] == parent]
    return f": choose one of {', '.join(beside)}" if beside else f" (see maexp {verb} --help)"


def _flat_names(node: DictConfig, prefix: str = "") -> list[str]:
    names = []
    for key in node:
        names.append(prefix + key)
        child = node._get_node(key)
        if isinstance(child, DictConfig) and not child._is_missing() and not child._is_none():
            names += _flat_names(child, f"{prefix}{key}.")
    return names
