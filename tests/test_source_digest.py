"""Digests of code: they follow what is imported, and nothing else."""

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
def test_a_digest_follows_the_imports(package, changed, matters, matters_within_data):
    def digests():
        source_digest.cache_clear()
        start = package / "reader.py"
        return source_digest(start, within=package), source_digest(start, within=package / "data")

    before = digests()
    (package / changed).write_text((package / changed).read_text() + "changed = 1\n")
    after = digests()
    assert [a != b for a, b in zip(before, after, strict=True)] == [matters, matters_within_data]


def test_relative_imports_are_followed(package):
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
def test_words_do_not_count(package, code, same):
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
def test_what_is_kept_depends_on_the_code_that_makes_it(start, within, needed, idle):
    found = {path.name for path in module._with_imports((module.PACKAGE / start,), (module.PACKAGE / within).resolve())}
    assert needed <= found and not idle & found
