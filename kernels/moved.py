"""Import paths of earlier versions: a module that has moved is found under its old name, with a warning."""

import importlib
import importlib.util
import sys
import warnings
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import CodeType, ModuleType

REMOVED_IN = "0.4"
"""Version of the package that drops the old paths."""


class _MovedModules(MetaPathFinder, Loader):
    """Finds modules by their old names and hands out the new ones, never a second copy."""

    def __init__(self) -> None:
        self.moved: dict[str, str] = {}

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        old = next((old for old in self.moved if fullname == old or fullname.startswith(f"{old}.")), None)
        new = old and self.moved[old] + fullname.removeprefix(old)
        there = new and importlib.util.find_spec(new)
        if not there:
            return None
        package = there.submodule_search_locations is not None
        return ModuleSpec(fullname, self, loader_state=new, is_package=package)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        new = spec.loader_state
        warnings.warn(f"{spec.name} is now {new}; version {REMOVED_IN} drops the old path", DeprecationWarning, 6)
        module = importlib.import_module(new)
        spec.loader_state = module.__spec__  # the import system is about to replace it
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = module.__spec__.loader_state

    def get_code(self, fullname: str) -> CodeType | None:
        """What `python -m` runs."""
        new = self.find_spec(fullname).loader_state
        return importlib.util.find_spec(new).loader.get_code(new)


_FINDER = _MovedModules()


def redirect_modules(package: str, moved: dict[str, str]) -> None:
    """Let old import paths of a package lead to the modules' new homes.

    Args:
        package: its full name
        moved: old path -> new path, both within the package; submodules follow
    """
    for old, new in sorted(moved.items(), key=lambda pair: -len(pair[0])):
        _FINDER.moved[f"{package}.{old}"] = f"{package}.{new}"
    if _FINDER not in sys.meta_path:
        sys.meta_path.insert(0, _FINDER)  # before the path of a moved package finds a second copy
