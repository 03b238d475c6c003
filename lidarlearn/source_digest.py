"""Hashes of source code, which tell whether other code made a stored file. Unlike versions, they need no upkeep."""

import ast
import hashlib
import inspect
import sys
import sysconfig
import uuid
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parent

_STANDARD_LIBRARY = Path(sysconfig.get_path("stdlib")).resolve()

Origin = Path | type | Callable[..., Any]


@cache
def source_digest(*origins: Origin, within: Path = PACKAGE) -> str:
    """Hash of source files and of all modules that they import, directly or indirectly.

    Only the syntax counts: comments, docstrings and line breaks do not change the hash. Imports of installed libraries
    are not followed, nor imports of a name that is only known at run time.

    Args:
        origins: files, classes or functions, of this package or of any other code. Classes and functions stand for
            their files and those of their base classes; in a notebook, for the cells that define them. If the source
            cannot be found, the hash differs in every process.
        within: imports of files of this package are followed only below this folder.
    """
    digest = hashlib.sha256()
    for path, syntax in sorted(_with_imports(origins, within).items()):
        name = path.relative_to(PACKAGE).as_posix() if path.is_relative_to(PACKAGE) else path.name
        digest.update(name.encode() + b"\0" + syntax + b"\0")
    return digest.hexdigest()[:12]


def _with_imports(origins: Iterable[Origin], within: Path) -> dict[Path, bytes]:
    """The syntax of every source file, see `_syntax`."""
    found: dict[Path, bytes] = {}
    ahead = [source for origin in origins for source in _sources(origin)]
    while ahead:
        path, cell = ahead.pop()
        if path not in found:
            found[path], imports = _syntax(path.read_bytes() if cell is None else cell)
            ahead += [(file, None) for file in _imports(path, imports) if _followed(file, within)]
    return found


@cache  # several digests share most of their files
def _syntax(source: bytes) -> tuple[bytes, list[ast.Import | ast.ImportFrom]]:
    """The syntax of a source without its docstrings, in bytes, and its imports at any place."""
    tree = _parsed(source)
    nodes = list(ast.walk(tree))
    for node in nodes:
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            if ast.get_docstring(node, clean=False) is not None:
                del node.body[0]
    return ast.dump(tree).encode(), [node for node in nodes if isinstance(node, (ast.Import, ast.ImportFrom))]


def _sources(origin: Origin) -> Iterator[tuple[Path, bytes | None]]:
    """The files of an origin, each with None; without a file, a name and the source that stands for it."""
    if isinstance(origin, Path):
        yield origin.resolve(), None
        return
    owner = origin.__self__ if inspect.ismethod(origin) else origin
    for part in inspect.getmro(owner) if inspect.isclass(owner) else (owner,):
        if not inspect.isclass(part) and not inspect.isroutine(part):  # an object, whose state is unknown
            yield Path(type(part).__name__).resolve(), _never_seen_before()
        elif (part.__module__ or "").partition(".")[0] not in sys.stdlib_module_names:
            file = getattr(sys.modules.get(part.__module__), "__file__", None)
            yield (Path(file).resolve(), None) if file else (Path(part.__qualname__).resolve(), _cell(part))


def _cell(part: type | Callable[..., Any]) -> bytes:
    """The source of the notebook cell that defines a function or a class; a class is found by its methods."""
    for function in filter(inspect.isfunction, [part, *getattr(part, "__dict__", {}).values()]):
        try:
            return "".join(inspect.findsource(function)[0]).encode()
        except OSError:  # no source, such as for the methods of a dataclass
            continue
    return _never_seen_before()


def _never_seen_before() -> bytes:
    return str(uuid.uuid4().int).encode()


def _parsed(source: bytes) -> ast.Module:
    try:
        return ast.parse(source)
    except (SyntaxError, ValueError):  # an extension module, or notebook magic: hash the bytes
        return ast.Module([ast.Expr(ast.Constant(source))], [])


def _followed(file: Path, within: Path) -> bool:
    if file.is_relative_to(PACKAGE):
        return file.is_relative_to(within)
    return not file.is_relative_to(_STANDARD_LIBRARY) and {"site-packages", "dist-packages"}.isdisjoint(file.parts)


def _imports(path: Path, nodes: Iterable[ast.Import | ast.ImportFrom]) -> Iterator[Path]:
    """The files of the modules that a file imports."""
    for node in nodes:
        if isinstance(node, ast.Import):
            folders, names = _import_folders(path), [alias.name for alias in node.names]
        else:  # only the disk tells whether an imported name is a module
            folders = [path.parents[node.level - 1]] if node.level else _import_folders(path)
            start = [node.module] if node.module else []
            names = [".".join(start), *(".".join([*start, alias.name]) for alias in node.names)]
        for name in names:
            modules = [folder.joinpath(*name.split(".")) for folder in folders]
            files = (file for module in modules for file in (module / "__init__.py", module.with_suffix(".py")))
            yield from (file.resolve() for file in islice(filter(Path.is_file, files), 1))


def _import_folders(path: Path) -> list[Path]:
    """The folders to search for absolute imports of a file, in this order."""
    if path.is_relative_to(PACKAGE):
        return [PACKAGE.parent]
    beside = next(folder for folder in path.parents if not (folder / "__init__.py").is_file())
    return [beside, *(Path(entry).resolve() for entry in sys.path), PACKAGE.parent]
