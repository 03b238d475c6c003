"""Rules that concern the package as a whole: dependencies, imports, encodings, length of files."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

import lidarlearn

PACKAGE = Path(lidarlearn.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))


@functools.cache
def nodes(path: Path) -> list[ast.AST]:
    """The syntax tree of a file, flattened."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@functools.cache
def imports_of(path: Path) -> frozenset[str]:
    """Full names of all modules that a file imports, at any depth."""
    names = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            names.add(node.module or "")
    return frozenset(names)


def importing(library: str) -> set[str]:
    """Modules that import a library, relative to the package."""
    return {
        str(path.relative_to(PACKAGE))
        for path in MODULES
        if any(name.split(".")[0] == library for name in imports_of(path))
    }


def packages_used_by(package: str) -> set[str]:
    """Packages of lidarlearn that a package of it imports."""
    names = {name for path in MODULES if path.relative_to(PACKAGE).parts[0] == package for name in imports_of(path)}
    used = {name.split(".")[1] for name in names if name.startswith("lidarlearn.")} - {package}
    return {name for name in used if (PACKAGE / name).is_dir()}


def test_modules_are_found():
    assert len(MODULES) > 50 and importing("torch")


def test_only_training_and_datamodule_import_lightning():
    allowed = {"data/datamodule.py", "commands/entry_point.py", "commands/train.py"}  # entry points start trainers
    assert {m for m in importing("lightning") if not m.startswith("training/")} <= allowed


@pytest.mark.parametrize("library", ["hydra", "omegaconf"])
def test_only_commands_and_training_import_hydra(library):
    assert not {m for m in importing(library) if not m.startswith(("commands/", "training/"))}


def test_only_raycasting_imports_open3d_and_lazily():
    assert importing("open3d") == {"simulation/raycasting.py"}
    tree = ast.parse((PACKAGE / "simulation/raycasting.py").read_text())
    top_level = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    assert not any("open3d" in ast.dump(node) for node in top_level)


@pytest.mark.parametrize(
    ("package", "may_use"),
    [
        ("geometry", set()),
        ("registration", {"geometry"}),
        ("odometry", {"geometry", "registration"}),
        ("losses", {"geometry"}),
        ("models", {"geometry"}),
        ("metrics", {"geometry"}),
    ],
)
def test_dependencies_point_one_way(package, may_use):
    assert packages_used_by(package) <= may_use


def test_only_commands_import_commands():
    users = [path for path in MODULES if any(name.startswith("lidarlearn.commands") for name in imports_of(path))]
    assert {path.relative_to(PACKAGE).parts[0] for path in users if path.name != "__main__.py"} <= {"commands"}


def test_no_module_is_named_utils():
    assert not [path for path in MODULES if {"utils", "helpers", "misc", "common"} & set(path.with_suffix("").parts)]
    assert not [path for path in MODULES if any("utils" in name for name in imports_of(path) if "lidarlearn" in name)]


def test_imports_do_not_load_heavy_libraries():
    """One process imports all modules in turn: what one must not load, those before it must not load either."""
    heavy = {
        "lidarlearn": {"torch", "open3d", "lightning", "hydra", "cv2", "scipy", "matplotlib"},
        "lidarlearn.odometry": {"open3d", "lightning", "hydra", "matplotlib", "torchvision"},
        "lidarlearn.data.sequence": {"open3d", "lightning", "hydra"},
        "lidarlearn.data.rosbag": {"open3d", "lightning", "hydra", "rosbags"},
        "lidarlearn.data.simulated": {"open3d", "lightning"},
        "lidarlearn.commands.evaluate": {"open3d", "lightning", "torchvision"},
    }
    program = "import sys\n" + "".join(f"import {module}; print(*sys.modules)\n" for module in heavy)
    printed = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    for (module, unwanted), loaded in zip(heavy.items(), printed.stdout.splitlines(), strict=True):
        assert not unwanted & set(loaded.split()), module


def is_text_access_without_encoding(node: ast.AST) -> bool:
    """Whether a call reads or writes text in the encoding of the locale."""
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
        return False
    binary = any(isinstance(a, ast.Constant) and a.value in ("rb", "wb", "ab") for a in node.args)
    is_text = node.func.attr in ("read_text", "write_text") or (node.func.attr == "open" and not binary)
    return is_text and not any(keyword.arg == "encoding" for keyword in node.keywords)


def test_text_files_are_opened_with_explicit_encoding():
    """Names of sequences may have any characters, and Hydra reads UTF-8."""
    lines = {
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path in MODULES
        for node in nodes(path)
        if is_text_access_without_encoding(node)
    }
    assert not lines


def test_files_stay_short():
    lengths = {str(path.relative_to(PACKAGE)): len(path.read_text().splitlines()) for path in MODULES}
    assert {name: count for name, count in lengths.items() if count > 280} == {}
