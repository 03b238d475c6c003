"""Digests of code depend on the modules that it imports, and on no others."""

import functools
import importlib
import linecache
import sys

import pytest

from lidarlearn import source_digest as module
from lidarlearn.source_digest import source_digest

FILES = {
    "package/__init__.py": "",
    "package/reader.py": "import numpy\nfrom package.data import layout\nimport package.angles\n",
    "package/data/__init__.py": "",
    "package/data/layout.py": "def f():\n    from package.far import g\n",
    "package/angles.py": "from package.reader import x  # a circle\n",
    "package/far.py": "",
    "package/other.py": "",
    "package/data/writer.py": "from . import layout\nfrom .. import near\nfrom ..deep.er import x\n",
    "package/near.py": "",
    "package/deep/__init__.py": "",
    "package/deep/er.py": "",
}


@pytest.fixture
def package(tmp_path, monkeypatch):
    for name, content in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    monkeypatch.setattr(module, "PACKAGE", tmp_path / "package")
    source_digest.cache_clear()
    yield tmp_path / "package"
    source_digest.cache_clear()


@pytest.mark.parametrize(
    ("changed", "matters", "matters_within_data"),
    [
        ("reader.py", True, True),
        ("data/layout.py", True, True),
        ("angles.py", True, False),
        ("far.py", True, False),
        ("other.py", False, False),
    ],
)
def test_digest_depends_on_imported_modules(package, changed, matters, matters_within_data):
    def digests():
        source_digest.cache_clear()
        start = package / "reader.py"
        return source_digest(start, within=package), source_digest(start, within=package / "data")

    before = digests()
    (package / changed).write_text((package / changed).read_text() + "changed = 1\n")
    after = digests()
    assert [a != b for a, b in zip(before, after, strict=True)] == [matters, matters_within_data]


def test_digest_follows_relative_imports(package):
    found = module._with_imports((package / "data" / "writer.py",), package)
    assert {path.name for path in found} >= {"layout.py", "near.py", "er.py", "far.py"}
    assert "other.py" not in {path.name for path in found}


@pytest.mark.parametrize(
    ("code", "same"),
    [
        ('"""Something else."""\n\n\ndef f(x):  # so\n    """That."""\n    return (x +\n        1)\n', True),
        ('def f(x):\n    return x + 1\nclass A:\n    """Bare."""\n', False),
        ("def f(x):\n    return x + 2\n", False),
        ('def f(x):\n    "one"\n    "two"\n    return x + 1\n', False),
    ],
)
def test_digest_ignores_comments_and_docstrings(package, code, same):
    path, digests = package / "other.py", []
    for content in ('"""Adds."""\ndef f(x):\n    return x + 1\n', code):
        path.write_text(content)
        source_digest.cache_clear()
        digests.append(source_digest(path))
    assert (digests[0] == digests[1]) == same


@pytest.mark.parametrize(
    ("start", "within", "needed", "idle"),
    [
        ("simulation/drive.py", "simulation", {"worlds.py", "sensors.py", "urban.py", "raycasting.py"}, set()),
        ("data/kitti.py", ".", {"scan_files.py", "beam_correction.py"}, {"augmentation.py", "nclt.py"}),
        ("data/cache.py", ".", {"projection.py", "ranges.py"}, {"datamodule.py", "pairs.py"}),
    ],
)
def test_digest_of_package_module_covers_its_imports(start, within, needed, idle):
    found = {path.name for path in module._with_imports((module.PACKAGE / start,), (module.PACKAGE / within).resolve())}
    assert needed <= found and not idle & found


OUTSIDE = {
    "beside/mine/__init__.py": "",
    "beside/mine/reader.py": """
import my_helper
from my_base import Base
class Reader(Base):
    @classmethod
    def make(cls):
        import a_library
        from . import lazy
def build(): ...
partial = __import__("functools").partial(build)
""",
    "beside/mine/lazy.py": "",
    "beside/my_helper.py": "def f():\n    from package.far import g\n",
    "beside/other.py": "",
    "on_path/my_base.py": "import my_registry\nclass Base: ...\n",
    "on_path/my_registry.py": "",
    "site-packages/a_library.py": "import inside\n",
}


@pytest.fixture
def outside(package, monkeypatch):
    """Modules outside the package that import each other, a library and the package."""
    root = package.parent
    for name, content in OUTSIDE.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(content)
    for folder in ("beside", "on_path", "site-packages"):
        monkeypatch.syspath_prepend(root / folder)
    yield root
    for name in ("mine", "mine.reader", "my_helper", "my_base", "my_registry"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("origin", ["Reader", "Reader.make", "build"])
@pytest.mark.parametrize(
    ("changed", "matters"),
    [
        ("beside/mine/reader.py", True),
        ("beside/mine/lazy.py", True),
        ("beside/my_helper.py", True),
        ("on_path/my_base.py", True),
        ("on_path/my_registry.py", True),
        ("package/far.py", True),
        ("beside/other.py", False),
        ("site-packages/a_library.py", False),
        ("package/other.py", False),
    ],
)
def test_digest_of_outside_class_covers_neighbouring_modules(outside, origin, changed, matters):
    digests = []
    for content in ("", "changed = 1\n"):
        with (outside / changed).open("a") as file:
            file.write(content)
        source_digest.cache_clear()
        start = functools.reduce(getattr, origin.split("."), _reader())
        digests.append(source_digest(start, within=outside / "package"))
    assert (digests[0] != digests[1]) == matters


def _reader():
    return importlib.import_module("mine.reader")


def test_digest_covers_base_classes(outside):
    built = type("Built", (_reader().Reader,), {"__module__": __name__})
    found = {path.name for path in module._with_imports((built,), outside / "package")}
    assert {"reader.py", "my_base.py", "my_registry.py", "test_source_digest.py"} <= found


CELL = "SCALE = 2\nclass Drive:\n    def scan(self):\n        import my_helper\n        return SCALE\n"


def _notebook(source, kept=True):
    """A class of a notebook: without a file, its source is in `linecache` alone."""
    name = "/tmp/ipykernel_1/1.py"
    linecache.cache.pop(name, None)
    if kept:
        linecache.cache[name] = (len(source), None, source.splitlines(keepends=True), name)
    namespace = {"__name__": "a_notebook"}
    exec(compile(source, name, "exec"), namespace)
    return namespace["Drive"]


@pytest.mark.parametrize(
    ("code", "same"),
    [(CELL + "# so\n", True), (CELL.replace("2", "3"), False), (CELL.replace("return", "return -"), False)],
)
def test_digest_of_notebook_class_depends_on_its_cell(outside, code, same):
    assert (source_digest(_notebook(CELL)) == source_digest(_notebook(code))) == same


def test_digest_of_notebook_class_covers_its_imports(outside):
    before = source_digest(_notebook(CELL))
    (outside / "beside" / "my_helper.py").write_text("changed = 1\n")
    assert source_digest(_notebook(CELL)) != before


def test_digest_without_source_differs_between_processes(outside):
    hidden, partial, empty = _notebook(CELL, kept=False), _reader().partial, _notebook("class Drive: ...\n")
    for origin in (hidden, partial, empty):
        before = source_digest(origin)
        assert source_digest(origin) == before  # the same within a process
        source_digest.cache_clear()  # as in a new process
        assert source_digest(origin) != before


def test_digest_of_unparsable_file_depends_on_its_bytes(package):
    path, digests = package / "other.py", []
    for content in (b"%magic a", b"%magic b", b"\x7fELF\0a", b"\x7fELF\0b"):
        path.write_bytes(content)
        source_digest.cache_clear()
        digests.append(source_digest(path))
    assert len(set(digests)) == 4
