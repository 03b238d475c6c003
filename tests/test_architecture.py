"""The rules of the house that no reader of a single file can see."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import lidarlearn

PACKAGE = Path(lidarlearn.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))


def imports_of(path: Path) -> Iterator[str]:
    """Full names of all modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            yield node.module or ""


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


def test_there_is_something_to_look_at():
    assert len(MODULES) > 50 and importing("torch")


def test_only_training_and_the_datamodule_import_lightning():
    allowed = {"data/datamodule.py", "commands/entry_point.py", "commands/train.py"}  # entry points start trainers
    assert {m for m in importing("lightning") if not m.startswith("training/")} <= allowed


@pytest.mark.parametrize("library", ["hydra", "omegaconf"])
def test_only_the_commands_and_training_import_hydra(library):
    assert not {m for m in importing(library) if not m.startswith(("commands/", "training/"))}


def test_one_module_imports_open3d_and_only_when_it_is_needed():
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


def test_nothing_that_computes_knows_the_commands():
    users = [path for path in MODULES if any(name.startswith("lidarlearn.commands") for name in imports_of(path))]
    assert {path.relative_to(PACKAGE).parts[0] for path in users if path.name != "__main__.py"} <= {"commands"}


def test_there_is_no_drawer_for_odds_and_ends():
    assert not [path for path in MODULES if {"utils", "helpers", "misc", "common"} & set(path.with_suffix("").parts)]
    assert not [path for path in MODULES if any("utils" in name for name in imports_of(path) if "lidarlearn" in name)]


def test_imports_stay_light():
    """One process imports more and more: what a later module may not load, none before it may."""
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


def leaves_encoding_to_the_machine(node: ast.AST) -> bool:
    """Whether a call reads or writes text in whatever encoding the locale has."""
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
        return False
    binary = any(isinstance(a, ast.Constant) and a.value in ("rb", "wb", "ab") for a in node.args)
    is_text = node.func.attr in ("read_text", "write_text") or (node.func.attr == "open" and not binary)
    return is_text and not any(keyword.arg == "encoding" for keyword in node.keywords)


def test_text_is_utf_8_on_every_machine():
    """Names of sequences are anything, and Hydra reads UTF-8."""
    lines = {
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path in MODULES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if leaves_encoding_to_the_machine(node)
    }
    assert not lines


def test_files_stay_short():
    lengths = {str(path.relative_to(PACKAGE)): len(path.read_text().splitlines()) for path in MODULES}
    assert {name: count for name, count in lengths.items() if count > 280} == {}
