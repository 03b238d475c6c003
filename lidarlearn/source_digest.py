"""What made a file that is kept: a hash of the code, instead of a version that someone has to remember to raise."""

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent


@cache
def source_digest(*files: Path, within: Path = PACKAGE) -> str:
    """Hash of source files and of all modules that they import, directly or not.

    The same code gives the same results, committed or not; other code may not. What counts is the syntax: comments,
    docstrings and line breaks do not. Libraries are not looked at.

    Args:
        files: where to begin.
        within: imports are followed only to files below this folder of the package.
    """
    digest = hashlib.sha256()
    for path, tree in sorted(_with_imports(files, within).items(), key=lambda file: file[0]):
        name = path.relative_to(PACKAGE).as_posix() if path.is_relative_to(PACKAGE) else path.name
        digest.update(name.encode() + b"\0" + ast.dump(_without_docstrings(tree)).encode() + b"\0")
    return digest.hexdigest()[:12]


def _with_imports(files: tuple[Path, ...], within: Path) -> dict[Path, ast.Module]:
    found: dict[Path, ast.Module] = {}
    ahead = [path.resolve() for path in files]
    while ahead:
        path = ahead.pop()
        if path not in found:
            found[path] = ast.parse(path.read_bytes())
            ahead += [file for file in _imports(path, found[path]) if file.is_relative_to(within)]
    return found


def _imports(path: Path, tree: ast.Module) -> Iterator[Path]:
    """The files of the package's modules that a file imports, wherever in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            origin, names = PACKAGE.parent, [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):  # of a name nobody can tell whether it is a module but the disk
            origin = path.parents[node.level - 1] if node.level else PACKAGE.parent
            start = [node.module] if node.module else []
            names = [".".join(start), *(".".join([*start, alias.name]) for alias in node.names)]
        else:
            continue
        for name in names:
            module = origin.joinpath(*name.split("."))
            yield from (file for file in (module.with_suffix(".py"), module / "__init__.py") if file.is_file())


def _without_docstrings(tree: ast.Module) -> ast.Module:
    """The tree, in place."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            if ast.get_docstring(node, clean=False) is not None:
                del node.body[0]
    return tree
