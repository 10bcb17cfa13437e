"""What kernels do with their array arguments, read from their source: under which heading each stands, which are
only read, which are written. Functions that a kernel calls are followed."""

import ast
import importlib
import inspect
import re
import textwrap
from dataclasses import dataclass, field
from functools import cache

import warp as wp
from test_compile import kernel_modules

DIMENSIONS = {"array": 1, "array2d": 2, "array3d": 3, "array4d": 4}
HEADING = re.compile(r"^\s*# ([A-Z][^:]*):")
SHAPE = re.compile(r"#.*?\[([^\]]*)\]")


@dataclass
class Argument:
    """An argument of a kernel as its signature shows it."""

    name: str
    heading: str
    dims: int  # 0: no array
    shape: tuple[str, ...] | None  # names of the axes in its comment


@dataclass
class Use:
    """What a kernel or function does with its arrays, and which arguments it names at all."""

    read: set[str] = field(default_factory=set)
    written: set[str] = field(default_factory=set)
    named: set[str] = field(default_factory=set)


def kernels() -> dict[str, wp.Kernel]:
    """Every kernel of ours, by ``module.name``."""
    found = {}
    for name in kernel_modules():
        for kernel in vars(importlib.import_module(name)).values():
            if isinstance(kernel, wp.Kernel) and kernel.module.name == name:
                found[f"{name.removeprefix('maexp.kernels.')}.{kernel.key}"] = kernel
    return found


def functions() -> dict[str, wp.Function]:
    """Every function that kernels call, by ``module.name``."""
    found = {}
    for name in {kernel.func.__module__ for kernel in kernels().values()} | {"maexp.kernels.occlusion"}:
        for function in vars(importlib.import_module(name)).values():
            if isinstance(function, wp.Function) and function.func is not None:
                module = function.func.__module__
                if module.startswith("maexp."):
                    found[f"{module.rsplit('.', 1)[1]}.{function.func.__name__}"] = function
    return found


def arguments(kernel: wp.Kernel) -> list[Argument]:
    """The arguments of a kernel in their order."""
    lines = inspect.getsource(kernel.func).splitlines()
    definition = parse(kernel.func)
    heading, headings = "", {}
    for number, line in enumerate(lines, 1):
        if HEADING.match(line):
            heading = HEADING.match(line)[1].split(",")[0]
        headings[number] = (heading, line)
    found = []
    for argument in definition.args.args:
        heading, line = headings[argument.lineno]
        shape = SHAPE.search(line)
        axes = tuple(part.strip() for part in shape[1].split(",")) if shape else None
        found.append(Argument(argument.arg, heading, dimensions(argument), axes))
    return found


def dimensions(argument: ast.arg) -> int:
    call = argument.annotation
    if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute):
        return DIMENSIONS.get(call.func.attr, 0)
    return 0


def parse(function) -> ast.FunctionDef:
    return ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]


@cache
def uses(function) -> Use:
    """How a kernel's or a function's Python source uses its arguments."""
    definition = parse(function)
    arrays = {argument.arg: dimensions(argument) for argument in definition.args.args}
    finder = Finder(arrays, function.__globals__)
    for statement in definition.body:
        finder.visit(statement)
    finder.found.named &= set(arrays)
    return finder.found


POINTER = re.compile(r"^ *(const )?[\w:]+\* \w+ = &wp::index\((\w+)", re.MULTILINE)


def uses_in_cpp(function: wp.Function) -> Use:
    """The same of a function in C++, which writes through pointers that are not const."""
    text = function.native_snippet
    read = set(re.findall(r"wp::index\((\w+)", text))
    return Use(read, {name for const, name in POINTER.findall(text) if not const})


class Finder(ast.NodeVisitor):
    """Collects reads and writes of arrays, also through names that stand for a row of one."""

    def __init__(self, arrays: dict[str, int], names: dict):
        self.arrays, self.names = arrays, names
        self.rows: dict[str, str] = {}
        self.found = Use()

    def owner(self, node: ast.expr) -> str | None:
        """The argument that a name stands for, if it is an array."""
        name = node.id if isinstance(node, ast.Name) else None
        name = self.rows.get(name, name)
        return name if self.arrays.get(name) else None

    def visit_Name(self, node: ast.Name) -> None:
        self.found.named.add(node.id)

    def visit_Assign(self, node: ast.Assign) -> None:
        value, target = node.value, node.targets[0]
        if isinstance(value, ast.Subscript) and isinstance(target, ast.Name) and self.owner(value.value):
            indices = len(value.slice.elts) if isinstance(value.slice, ast.Tuple) else 1
            if indices < self.arrays[self.owner(value.value)] and value.value.id not in self.rows:
                self.rows[target.id] = self.owner(value.value)
                self.visit(value.slice)
                self.found.named.add(value.value.id)
                return
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        if isinstance(node.target, ast.Subscript) and self.owner(node.target.value):
            self.found.read.add(self.owner(node.target.value))
        self.generic_visit(node)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        owner = self.owner(node.value)
        if owner:
            (self.found.read if isinstance(node.ctx, ast.Load) else self.found.written).add(owner)
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        called = node.func
        if isinstance(called, ast.Attribute) and called.attr.startswith("atomic_"):
            self.found.read.add(self.owner(node.args[0]))
            self.found.written.add(self.owner(node.args[0]))
        function = self.names.get(called.id) if isinstance(called, ast.Name) else None
        if isinstance(function, wp.Function) and function.func is not None:
            inside = uses_in_cpp(function) if function.native_snippet else uses(function.func)
            for given, taken in zip(node.args, parse(function.func).args.args, strict=False):
                if self.owner(given):
                    for whole, part in ((self.found.read, inside.read), (self.found.written, inside.written)):
                        whole |= {self.owner(given)} if taken.arg in part else set()
        self.generic_visit(node)
