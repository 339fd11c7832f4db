"""Measure how many small faults in the code the tests catch: `python -m tests.support.mutation --count 40 --seed 1`.

A mutation changes one operator, comparison, number or condition in a function of `core` or `stream`. The tests that
import the mutated module run first, then those of the pipeline and the commands. The whole suite runs at the end on the
mutations that survive these. The first failure ends a run and is printed. Every mutation is made in a copy of the tree,
whose tests must pass without one.
"""

import argparse
import ast
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

ROOT: Final = Path(__file__).parents[2]
TIMEOUT: Final = 3600.0
"""A test run that takes longer counts as a failure, because a mutation can make a loop endless. [s]"""
ENDLESS: Final = "a test that did not end"
SWAPS: Final[dict[type[Any], type[Any]]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Lt: ast.GtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
}
GENERAL: Final = ("pipeline", "laws", "cli", "loop", "run", "engine")
"""Words in the names of test files that run after those of the mutated module."""


class Mutation(NamedTuple):
    """One change of a file.

    Parameters
    ----------
    path : Path
        File, relative to the tree.
    line : int
        Line of the change.
    source : str
        The whole file after the change.
    what : str
        The changed statement before and after.
    """

    path: Path
    line: int
    source: str
    what: str


def places(tree: ast.Module) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Yield each statement and a node in it that can be mutated; annotations and messages are left out."""
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        for statement in (s for child in function.body for s in ast.walk(child) if isinstance(s, ast.stmt)):
            if isinstance(statement, ast.FunctionDef | ast.Raise | ast.AnnAssign | ast.Import | ast.ImportFrom):
                continue
            heads = [statement] if not hasattr(statement, "body") else [getattr(statement, "test", None)]
            for head in (h for h in heads if h is not None):
                yield from ((statement, node) for node in ast.walk(head) if can_change(node))


def can_change(node: ast.AST) -> bool:
    """Tell whether a node is an operator, comparison, condition or number that `change` can mutate."""
    if isinstance(node, ast.BinOp | ast.BoolOp):
        return type(node.op) in SWAPS
    if isinstance(node, ast.Compare):
        return type(node.ops[0]) in SWAPS
    if isinstance(node, ast.UnaryOp):
        return isinstance(node.op, ast.Not | ast.USub)
    return isinstance(node, ast.Constant) and type(node.value) in {int, float}


def change(node: Any) -> None:
    """Mutate a node in place."""
    if isinstance(node, ast.BinOp | ast.BoolOp):
        node.op = SWAPS[type(node.op)]()
    elif isinstance(node, ast.Compare):
        node.ops[0] = SWAPS[type(node.ops[0])]()
    elif isinstance(node, ast.UnaryOp):
        node.op = ast.UAdd() if isinstance(node.op, ast.USub) else ast.Not()
        if isinstance(node.op, ast.Not):
            node.operand = ast.UnaryOp(ast.Not(), node.operand)
    else:
        node.value = node.value + 1 if isinstance(node.value, int) else node.value * 1.5 + 0.1


def sample(root: Path, count: int, seed: int) -> list[Mutation]:
    """Return mutations at places drawn at random from every function of core and stream."""
    mutations = []
    for path in sorted(p for package in ("core", "stream") for p in (root / package).rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        mutations += [(path, i) for i in range(len(list(places(tree))))]
    return [mutated(root, *place) for place in random.Random(seed).sample(mutations, count)]


def mutated(root: Path, path: Path, place: int) -> Mutation:
    """Return the mutation at a place of a file."""
    text = path.read_text(encoding="utf-8")
    statement, node = list(places(ast.parse(text)))[place]
    first, last = statement.lineno, statement.end_lineno or statement.lineno  # type: ignore[attr-defined]
    if hasattr(statement, "test"):
        first, last = statement.test.lineno, statement.test.end_lineno
    before = ast.unparse(getattr(statement, "test", statement))
    change(node)
    after = ast.unparse(getattr(statement, "test", statement))
    lines = text.splitlines(keepends=True)
    if hasattr(statement, "test"):
        head, tail = lines[first - 1][: statement.test.col_offset], lines[last - 1][statement.test.end_col_offset :]
        lines[first - 1 : last] = [f"{head}({after}){tail}"]
    else:
        indent = " " * statement.col_offset  # type: ignore[attr-defined]
        lines[first - 1 : last] = [f"{indent}{row}\n" for row in after.splitlines()]
    source = "".join(lines)
    ast.parse(source)
    return Mutation(path.relative_to(root), first, source, f"{before}  ->  {after}")


def related_tests(root: Path, path: Path) -> list[Path]:
    """Return test files: the mirrored one first, then those that import the module, then those of the whole."""
    module = ".".join(path.with_suffix("").parts)
    package = module.rpartition(".")[0]
    ranks: dict[Path, int] = {}
    for test in sorted((root / "tests").rglob("test_*.py")):
        text = test.read_text(encoding="utf-8")
        if path.stem in test.stem and path.parent.name in str(test.parent):
            ranks[test] = 0
        elif module in text or f"from {package} import {path.stem}" in text:
            ranks[test] = 1
        elif package.count(".") and package in text:
            ranks[test] = 2
        elif any(word in test.stem for word in GENERAL):
            ranks[test] = 3
    return sorted(ranks, key=lambda test: ranks[test])


def find_failure(root: Path, tests: list[str]) -> str | None:
    """Run tests until one fails; return the name of that test, `None` where all pass."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(
            command,
            cwd=root,
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=False,
            env=os.environ | {"PYTHONPATH": str(root)},
        )
    except subprocess.TimeoutExpired:
        return ENDLESS
    if done.returncode == 0:
        return None
    named = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return named[1] if named else "the start of the tests"


def find_catching_test(root: Path, mutation: Mutation, *, everything: bool) -> str | None:
    """Return the name of a test that fails under a mutation, of the related ones or of all; `None` where all pass."""
    file = root / mutation.path
    unchanged = file.read_text(encoding="utf-8")
    tests = ["-n", "auto"] if everything else [str(test) for test in related_tests(root, mutation.path)]
    file.write_text(mutation.source, encoding="utf-8")
    try:
        return find_failure(root, tests) if tests else None
    finally:
        file.write_text(unchanged, encoding="utf-8")


def main() -> None:
    """Print each mutation with its outcome, and how many were caught."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--tree", type=Path, default=ROOT, help="the tree to mutate a copy of")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "tree"
        shutil.copytree(given.tree, copy, ignore=shutil.ignore_patterns(".git", ".venv", ".mypy_cache", "build"))
        if failed := find_failure(copy, ["-n", "auto"]):
            sys.exit(f"{failed} fails without a mutation: repair it first")
        remaining = sample(copy, given.count, given.seed)
        for everything in (False, True):
            survivors = []
            for mutation in remaining:
                test = find_catching_test(copy, mutation, everything=everything)
                outcome = f"caught by {test}" if test else "SURVIVED " + ("all tests" if everything else "its tests")
                print(f"{mutation.path}:{mutation.line}: {mutation.what[:160]}\n    {outcome}", flush=True)
                survivors += [] if test else [mutation]
            remaining = survivors
    caught = given.count - len(remaining)
    print(f"{caught} of {given.count} mutations were caught")


if __name__ == "__main__":
    main()
