"""One wrong operator or constant, anywhere in the package: where they can be planted, and a fair draw of them.

Left out are texts, annotations, what is raised or logged, bounds of configuration keys, and what only looks or paces:
colours, widths of lines, time-outs, sizes of caches.
"""

from __future__ import annotations

import ast
import hashlib
import random
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

GROUPS = {  # folder or file of the package: share of the faults
    "sim": 0.27, "control": 0.22, "tasks": 0.22, "rig": 0.08, "evaluation": 0.07, "ros": 0.05, "px4": 0.05,
    "envs": 0.03, "math3d.py": 0.01,
}  # fmt: skip
KINDS = {  # kind: weight of each of its sites
    "arithmetic": 3.0, "sign": 2.0, "half": 3.0, "constant": 2.0, "integer": 0.5, "index": 1.0, "comparison": 1.0,
    "equality": 0.5, "logic": 1.5, "function": 3.0, "switch": 0.5,
}  # fmt: skip
PER_FUNCTION = 2  # faults at most
NO_FAULTS = ("evaluation/plots.py", "__main__.py", "__init__.py", "tasks/task_checks.py", "deploy/ros/dds.py")
_COSMETIC = re.compile(
    r"rgba|colou?r|\.width\b|_WALL\b|_WAIT\b|timeout|TIMEOUT|KEPT|linewidth|alpha|maxsize|_CONVERGED|_MAX_COR"
)
_DRAWN = {"_add_surroundings", "_add_light", "_add_rotorcraft", "_add_target", "_edges", "_rims", "_payload_form"}
_INDIFFERENT = {"indent", "strict", "encoding", "rcond", "flush"}  # keywords
_REPORTS = {"warn", "warn_once", "print", "info", "warning", "error", "debug", "ConfigError", "describe", "join"}
_PATHS = re.compile(r"Path|path|folder|home|root|file|directory", re.IGNORECASE)

SWAPPED = {
    "min": "max", "minimum": "maximum", "add": "sub", "mul": "tmul", "sin": "cos", "any": "all", "floor": "ceil",
}  # fmt: skip
SWAPPED |= {second: first for first, second in SWAPPED.items()}
_ARITHMETIC = {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*")}
_COMPARED = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="),
}  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """One wrong operator or constant."""

    file: str
    """In the package, with slashes."""
    line: int
    function: str
    """Qualified name of the function that it is in; of a class or empty for what is run at import."""
    names: tuple[str, ...]
    """What is assigned there, if it is run at import."""
    kind: str
    start: int
    """Offset in the file's bytes."""
    old: str
    new: str
    before: str
    """The line, stripped."""
    after: str
    compiled: bool = False
    """Whether its function is a kernel."""

    @property
    def key(self) -> str:
        """Return a name that stays while the line and what is before it in its function stay."""
        text = "\0".join((self.file, self.function, self.before, self.after, str(self.line)))
        return hashlib.sha256(text.encode()).hexdigest()[:10]

    def planted(self, source: bytes) -> bytes:
        """Return the file's content with the fault."""
        old = self.old.encode()
        assert source[self.start : self.start + len(old)] == old
        return source[: self.start] + self.new.encode() + source[self.start + len(old) :]

    def as_dict(self) -> dict[str, Any]:
        """Return all of it for JSON."""
        return {"key": self.key, **asdict(self)}


class _Finder(ast.NodeVisitor):
    """Collects the faults that a file can have."""

    def __init__(self, file: str, source: bytes):
        self.file, self.source, self.faults = file, source, list[Fault]()
        self.lines = source.split(b"\n")
        self.starts = [0]
        for line in self.lines:
            self.starts.append(self.starts[-1] + len(line) + 1)
        self.scope, self.in_function, self.names = list[str](), False, tuple[str, ...]()
        self.compiled = False

    def offset(self, line: int, column: int) -> int:
        return self.starts[line - 1] + column

    def begin(self, node: Any) -> int:
        return self.offset(node.lineno, node.col_offset)

    def end(self, node: Any) -> int:
        return self.offset(node.end_lineno, node.end_col_offset)

    def add(self, kind: str, start: int, old: str, new: str) -> None:
        number = next(i for i, begin in enumerate(self.starts) if begin > start)
        line, column = self.lines[number - 1], start - self.starts[number - 1]
        text = line.decode()
        if _COSMETIC.search(text):
            return
        after = (line[:column] + new.encode() + line[column + len(old.encode()) :]).decode()
        function = ".".join(self.scope)
        if self.file == "sim/scene.py" and (function in _DRAWN or not function):
            return
        names = () if self.in_function else self.names
        texts = text.strip(), after.strip()
        self.faults.append(Fault(self.file, number, function, names, kind, start, old, new, *texts, self.compiled))

    def between(self, kind: str, first: Any, second: Any, old: str, new: str) -> None:
        """Add the fault of an operator between two expressions."""
        start = self.end(first)
        gap = self.source[start : self.begin(second)].decode()
        found = re.search(
            rf"(?<![\w*/<>=!]){re.escape(old)}(?![\w*/<>=]|$)" if old[0].isalpha() else re.escape(old), gap
        )
        if found and "#" not in gap:
            self.add(kind, start + len(gap[: found.start()].encode()), old, new)

    # What is left out

    def visit_Raise(self, node):
        pass

    visit_JoinedStr = visit_Assert = visit_Import = visit_ImportFrom = visit_Raise

    def visit_AnnAssign(self, node):
        if node.value is not None:
            self.at_import(node, [node.target], node.value)

    def visit_Assign(self, node):
        self.at_import(node, node.targets, node.value)
        for target in node.targets:
            if not isinstance(target, ast.Name):
                self.visit(target)

    def at_import(self, node, targets, value):
        """Visit a value, the names of what it is assigned to noted."""
        if not self.in_function:
            found = (each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name))
            self.names = tuple(found)
        self.visit(value)

    def visit_If(self, node):
        if not (isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"):
            self.generic_visit(node)

    def visit_FunctionDef(self, node):
        outer, local = (self.in_function, self.compiled), ["<locals>"] if self.in_function else []
        self.scope += [*local, node.name]
        decorators = {each.id for each in node.decorator_list if isinstance(each, ast.Name)}
        self.in_function, self.compiled = True, bool(decorators & {"kernel", "inlined", "drawing"})
        for default in (*node.args.defaults, *(each for each in node.args.kw_defaults if each)):
            self.visit(default)
        for statement in node.body:
            self.visit(statement)
        del self.scope[-1 - len(local) :]
        self.in_function, self.compiled = outer

    visit_AsyncFunctionDef = visit_FunctionDef

    def visit_ClassDef(self, node):
        self.scope.append(node.name)
        outer, self.in_function = self.in_function, False
        for statement in node.body:
            self.visit(statement)
        self.in_function = outer
        self.scope.pop()

    # What can be planted

    def visit_BinOp(self, node):
        self.generic_visit(node)
        if type(node.op) in _ARITHMETIC and not self.is_text(node):
            self.between("arithmetic", node.left, node.right, *_ARITHMETIC[type(node.op)])

    def is_text(self, node) -> bool:
        """Return whether an operator joins texts, lists or paths."""
        literal = (ast.JoinedStr, ast.List, ast.Tuple, ast.Dict, ast.ListComp)
        for side in (node.left, node.right):
            if isinstance(side, literal) or (isinstance(side, ast.Constant) and isinstance(side.value, str | bytes)):
                return True
        text = self.source[self.begin(node) : self.end(node)].decode()
        return isinstance(node.op, ast.Div) and bool(_PATHS.search(text))

    def visit_AugAssign(self, node):
        self.visit(node.value)
        if type(node.op) in _ARITHMETIC:
            old, new = _ARITHMETIC[type(node.op)]
            self.between("arithmetic", node.target, node.value, old + "=", new + "=")

    def visit_Compare(self, node):
        self.generic_visit(node)
        if len(node.ops) == 1 and type(node.ops[0]) in _COMPARED:
            kind = "equality" if isinstance(node.ops[0], ast.Eq | ast.NotEq) else "comparison"
            self.between(kind, node.left, node.comparators[0], *_COMPARED[type(node.ops[0])])

    def visit_BoolOp(self, node):
        self.generic_visit(node)
        if len(node.values) == 2:
            old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
            self.between("logic", *node.values, old, new)

    def visit_UnaryOp(self, node):
        if isinstance(node.op, ast.USub):
            self.add("sign", self.begin(node), "-", "")
            if not isinstance(node.operand, ast.Constant):
                self.visit(node.operand)
        elif isinstance(node.op, ast.Not):
            self.add("logic", self.begin(node), "not ", "")
            self.visit(node.operand)

    def visit_Subscript(self, node):
        self.visit(node.value)
        parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        for part in parts:
            if isinstance(part, ast.Constant) and type(part.value) is int:
                other = {0: 1, 1: 0}.get(part.value, part.value - 1)
                self.add("index", self.begin(part), str(part.value), str(other))
            else:
                self.visit(part)

    def visit_Call(self, node):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in _REPORTS:
            return
        if name in SWAPPED and (isinstance(node.func, ast.Name) or getattr(node.func.value, "id", "") == "np"):
            self.add("function", self.end(node.func) - len(name), name, SWAPPED[name])
        self.visit(node.func)
        for argument in node.args:
            self.visit(argument)
        for keyword in node.keywords:
            described = name in ("Field", "add_argument", "Component") and keyword.arg != "default"
            if not described and keyword.arg not in _INDIFFERENT:
                self.visit(keyword.value)

    def visit_Constant(self, node):
        value, start = node.value, self.begin(node)
        text = self.source[start : self.end(node)].decode()
        if isinstance(value, bool):
            self.add("switch", start, text, str(not value))
        elif isinstance(value, float) and value != 0.0:
            half = {0.5: "1.0", 1.0: "0.5"}.get(value)
            self.add("half" if half else "constant", start, text, half or repr(1.2 * value))
        elif isinstance(value, int):
            self.add("integer", start, text, str(value + 1 if abs(value) < 10 else round(1.2 * value)))


def faults_of(package: Path, file: str) -> list[Fault]:
    """Return the faults that a file of the package can have, in the order of their places."""
    source = (package / file).read_bytes()
    finder = _Finder(file, source)
    finder.visit(ast.parse(source))
    return sorted(finder.faults, key=lambda fault: (fault.start, fault.new))


def _sites(package: Path, group: str) -> Iterator[Fault]:
    paths = [package / group] if group.endswith(".py") else sorted((package / group).rglob("*.py"))
    for path in paths:
        file = path.relative_to(package).as_posix()
        if not file.endswith(NO_FAULTS):
            yield from faults_of(package, file)


def draw(package: Path, seed: int, count: int) -> list[Fault]:
    """Return faults drawn over the folders by their shares, by the weights of kinds within; few of one function."""
    rng, groups = random.Random(seed), {group: list(_sites(package, group)) for group in GROUPS}
    drawn, of_function = list[Fault](), dict[tuple[str, str], int]()
    while len(drawn) < count:
        (group,) = rng.choices(list(GROUPS), list(GROUPS.values()))
        sites = groups[group]
        if not sites:
            continue
        (fault,) = rng.choices(sites, [KINDS[site.kind] for site in sites])
        sites.remove(fault)
        place = fault.file, fault.function
        if of_function.get(place, 0) < PER_FUNCTION:
            of_function[place] = of_function.get(place, 0) + 1
            drawn.append(fault)
    return drawn
